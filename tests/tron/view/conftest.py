"""A floor, a ball and a ring under two lights, a studio that keeps what it shows, and a real browser.

That is Debian's Chromium, driven by Playwright.
"""

import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from examples.stage import make_scene
from tron.cameras import Camera
from tron.gaussians.scene import GaussianScene
from tron.shading.environments.environment import EnvironmentMap
from tron.view.studio import Picture, Studio

PATIENCE = 300
"""Seconds to wait for a picture."""
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


class Shown:
    """The pictures of a studio, in their order, and its notices."""

    def __init__(self) -> None:
        self.pictures: list[Picture] = []
        self.notices: list[str] = []
        self.came = threading.Condition()

    def show(self, view: int, picture: Picture) -> None:
        with self.came:
            self.pictures.append(picture)
            self.came.notify_all()

    def notice(self, line: str) -> None:
        with self.came:
            self.notices.append(line)
            self.came.notify_all()

    def until(self, holds: Callable[[], Any]) -> None:
        with self.came:
            assert self.came.wait_for(holds, PATIENCE)

    def final(self, studio: Studio, camera: Camera) -> Picture:
        """The last picture of the wish of the moment and a camera."""
        wish = studio.wished

        def done() -> bool:
            last = self.pictures[-1] if self.pictures else None
            return last is not None and (last.refined, last.wish, last.camera) == (1, wish, camera)

        self.until(done)
        return self.pictures[-1]


@pytest.fixture(scope="session")
def scene() -> GaussianScene:
    return make_scene(0.12)


def sky(column: int) -> EnvironmentMap:
    image = np.full((16, 32, 3), 0.3, np.float32)
    image[4:6, column : column + 3] = (30, 25, 20)
    return EnvironmentMap(image)


@pytest.fixture(scope="session")
def lights() -> dict[str, EnvironmentMap]:
    return {"east": sky(8), "west": sky(24)}


@pytest.fixture(scope="session")
def camera(scene) -> Camera:
    return Camera.around(scene, azimuth_deg=30, width=64, height=48)


@pytest.fixture
def open_studio(scene, lights, camera, variant) -> Callable[..., Any]:
    @contextmanager
    def opened(**changes: Any) -> Iterator[tuple[Studio, Shown]]:
        shown = Shown()
        given = {"scene": scene, "lights": lights, "home": camera} | changes
        with Studio(**given, show=shown.show, notice=shown.notice, variant=variant) as studio:
            yield studio, shown

    return opened


@pytest.fixture(scope="session")
def free_port() -> Callable[[], int]:
    def found() -> int:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            return probe.getsockname()[1]

    return found


@pytest.fixture
def browse() -> Iterator[Callable[..., Any]]:
    """Opens an address in a browser of its own; the page lists ``complaints`` of its console."""
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    if (program := shutil.which("chromium")) is None:
        pytest.skip("no chromium: apt-get install chromium")

    def is_error(said: Any) -> bool:
        """viser gives a picture up that a newer one replaces while it loads: no error."""
        return said.type == "error" and not said.location["url"].startswith("blob:")

    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=program, args=FLAGS)

        def opened(address: str, width: int = 620, height: int = 900) -> Any:
            page = browser.new_context(viewport={"width": width, "height": height}).new_page()
            page.complaints = []
            page.on("console", lambda said: is_error(said) and page.complaints.append(said.text))
            page.on("pageerror", lambda error: page.complaints.append(str(error)))
            page.goto(address)
            page.wait_for_selector("text=Exposure", state="attached", timeout=60_000)
            return page

        yield opened
        browser.close()


@pytest.fixture(scope="session")
def pull() -> Callable[[Any, Any, int], None]:
    """Presses the middle of a box of a page and moves sideways by some pixels."""

    def pulled(page: Any, box: Any, by: int) -> None:
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        for step in range(1, 6):
            page.mouse.move(x + by * step / 5, y)
            time.sleep(0.1)
        page.mouse.up()

    return pulled
