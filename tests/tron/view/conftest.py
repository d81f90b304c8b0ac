"""A floor, a ball and a ring under two lights, and a studio that keeps what it shows."""

import threading
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
