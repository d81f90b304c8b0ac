"""The window in a real browser: Debian's Chromium, driven by Playwright."""

import shlex
import shutil
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.stage import BALL
from tron.apps.relight.settings import Settings as Relight
from tron.cameras import Camera
from tron.cli.recipes import check, compose_recipe
from tron.editing import EditList, Material
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.io.images import read_image
from tron.view.window import Window, require_free_port

PATIENCE = 120
BROWSER = shutil.which("chromium")
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def is_error(said: Any) -> bool:
    """Of a console's line; viser gives a picture up that a newer one replaces while it loads."""
    return said.type == "error" and not said.location["url"].startswith("blob:")


@pytest.fixture
def window(scene, lights, variant, tmp_path) -> Iterator[Window]:
    files = {}
    for name, light in lights.items():
        files[name] = tmp_path / f"{name}.exr"
        light.save(files[name])
    scene.save(tmp_path / "scene.ply")
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 10\nend_header\n")
    models = {"broken": tmp_path / "broken.ply", "whole": tmp_path / "scene.ply"}
    home = Camera.around(scene.upright(), azimuth_deg=30, width=96, height=80)
    opened = Window(
        scene, tmp_path / "scene.ply", files, models, tmp_path / "saved", "127.0.0.1", free_port(), home,
        variant=variant, threads=1,
    )  # fmt: skip
    yield opened
    opened.close()


@pytest.fixture
def page(window) -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    if BROWSER is None:
        pytest.skip("no chromium: apt-get install chromium")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=BROWSER, args=FLAGS)
        opened = browser.new_context(viewport={"width": 620, "height": 900}).new_page()
        opened.complaints = []
        opened.on("console", lambda said: is_error(said) and opened.complaints.append(said.text))
        opened.on("pageerror", lambda error: opened.complaints.append(str(error)))
        opened.goto(f"http://127.0.0.1:{window._server.get_port()}")
        opened.wait_for_selector("text=Exposure", timeout=60_000)
        yield opened
        browser.close()


def final(window: Window) -> np.ndarray:
    """The picture of the wish of the moment, nothing left to refine; the same for a second."""
    ends = time.monotonic() + PATIENCE
    while time.monotonic() < ends:
        time.sleep(1.0)
        pictures = list(window._last.values())
        if pictures and all(p.refined == 1 and p.wish == window.studio.wished for p in pictures):
            return pictures[0].image
    raise AssertionError("no final picture")


def shot(page: Any) -> np.ndarray:
    """Left of the panel, 8-bit."""
    import cv2

    data = np.frombuffer(page.screenshot(clip={"x": 0, "y": 200, "width": 280, "height": 600}), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert image is not None
    return image.astype(int)


def drag(page: Any, number: int, by: int) -> None:
    """Move the thumb of a slider, counted from above."""
    box = page.locator("[role=slider]").nth(number).bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 6):
        page.mouse.move(x + by * step / 5, y)
        time.sleep(0.1)
    page.mouse.up()


TURN, STOPS, ROUGHNESS, METALLIC = range(4)


@pytest.mark.long
def test_sliders_change_the_picture_and_undo_brings_it_back(window, page):
    first, seen = final(window), shot(page)
    drag(page, TURN, 40)
    turned = final(window)
    assert window.studio.wished.turn > 0
    assert np.abs(turned.astype(int) - first).mean() > 1
    assert np.abs(shot(page) - seen).mean() > 1, "the browser shows it"
    label = next(name for name, number in window._numbers.items() if number == BALL)
    page.get_by_role("combobox", name="Object").click()
    page.get_by_role("option", name=label, exact=True).click()
    time.sleep(1)
    drag(page, METALLIC, 60)
    painted = final(window)
    (edit,) = window.studio.wished.edits
    assert isinstance(edit, Material)
    assert isinstance(edit.metallic, float)
    assert edit.metallic > 0.2
    assert np.abs(painted.astype(int) - turned).max() > 20
    page.get_by_role("button", name="Undo").click()
    np.testing.assert_array_equal(final(window), turned)
    page.get_by_role("button", name="Redo").click()
    np.testing.assert_array_equal(final(window), painted)
    assert page.complaints == []


@pytest.mark.long
def test_a_second_client_sees_the_same_scene(window, page):
    final(window)
    other = page.context.new_page()
    other.goto(page.url)
    other.wait_for_selector("text=Exposure", timeout=60_000)
    drag(other, STOPS, 30)
    final(window)
    assert len(window._last) == 2
    one, two = window._last.values()
    assert one.wish == two.wish
    assert one.wish.stops > 0
    other.close()
    drag(page, STOPS, -20)
    final(window)
    assert len(window._last) == 1


@pytest.mark.long
def test_what_is_saved_is_what_is_shown(window, page, tmp_path):
    picture = final(window)
    window._chosen = BALL
    window._paint(roughness=0.9)
    picture = final(window)
    page.get_by_text("Save", exact=True).first.click()
    for what in ("Picture", "Scene", "Film"):
        page.get_by_role("button", name=what).click()
        time.sleep(1)
    saved = tmp_path / "saved"
    np.testing.assert_allclose(read_image(saved / "picture-001.png"), picture / 255, atol=1e-6)
    written = GaussianScene.load(saved / "scene-001.ply")
    assert (written.roughness[written.object_id == BALL] == np.float32(0.9)).all()
    assert EditList.read(saved / "edits-001.yaml").edits == window.studio.wished.edits
    page.wait_for_selector("text=tron-relight scene=")
    name, *words = shlex.split(window._saved.content.strip("`\n"))
    film = check(compose_recipe("conf.relight", Relight, words), Relight)
    assert name == "tron-relight"
    assert (film.scene, film.cameras) == (saved / "scene-002.ply", saved / "view-001.json")
    assert film.scene.read_bytes() == (saved / "scene-001.ply").read_bytes()
    assert page.complaints == []


@pytest.mark.usefixtures("page")
@pytest.mark.long
def test_a_broken_model_is_a_notice_and_the_server_goes_on(window):
    picture = final(window)
    window._model.value = "broken"
    window._insert()
    np.testing.assert_array_equal(final(window), picture)
    window._model.value = "whole"
    window._insert()
    assert np.abs(final(window).astype(int) - picture).max() > 20
    assert len(window._numbers) == 4


def test_a_port_in_use_is_said():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(TronError, match=f"cannot listen on 127.0.0.1:{port}: Address already in use"):
            require_free_port("127.0.0.1", port)


def test_files_are_saved_under_free_names_in_the_folder_alone(window, tmp_path: Path):
    names = [window._path("scene", ".ply") for _ in range(2)]
    names[0].touch()
    names.append(window._path("scene", ".ply"))
    assert [str(each.relative_to(tmp_path / "saved")) for each in names] == [
        *("scene-001.ply", "scene-001.ply"),
        "scene-002.ply",
    ]
