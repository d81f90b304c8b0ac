"""The window in a real browser: Debian's Chromium, driven by Playwright."""

import shlex
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from examples.stage import BALL
from tron.apps.relight.settings import Settings as Relight
from tron.cameras import Camera
from tron.cli.recipes import check, compose_recipe
from tron.editing import EditList, Material, Separate
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.io.images import read_image
from tron.scans.camera_files import read_cameras
from tron.view.window import Window, require_free_port

PATIENCE = 120


@pytest.fixture
def window(scene, lights, variant, tmp_path, free_port) -> Iterator[Window]:
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
def page(window, browse) -> Any:
    return browse(window.address)


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


@pytest.fixture
def drag(pull) -> Callable[[Any, int, int], None]:
    """Moves the thumb of a slider, counted from above."""
    return lambda page, number, by: pull(page, page.locator("[role=slider]").nth(number).bounding_box(), by)


TURN, STOPS, DIVIDER, ROUGHNESS, METALLIC = range(5)


@pytest.mark.long
def test_sliders_change_the_picture_and_undo_brings_it_back(window, page, drag):
    first, seen = final(window), shot(page)
    drag(page, TURN, 40)
    turned = final(window)
    assert window.studio.wished.turn > 0
    assert np.abs(turned.astype(int) - first).mean() > 1
    assert np.abs(shot(page) - seen).mean() > 1, "the browser shows it"
    label = next(name for name, number in window.objects.numbers.items() if number == BALL)
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
def test_a_second_client_sees_the_same_scene(window, page, drag):
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
    window.objects.take(BALL)
    window.objects.paint(roughness=0.9)
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
    name, *words = shlex.split(window.saving.told)
    film = check(compose_recipe("conf.relight", Relight, words), Relight)
    assert name == "tron-relight"
    assert (film.scene, film.cameras) == (saved / "scene-002.ply", saved / "view-001.json")
    assert film.scene.read_bytes() == (saved / "scene-001.ply").read_bytes()
    assert page.complaints == []


@pytest.fixture
def dragged(pull) -> Callable[[Any, str, int], None]:
    """Drags an element of a class sideways."""

    def moved(page: Any, name: str, by: int) -> None:
        pull(page, page.locator(name).bounding_box(), by)
        time.sleep(1)

    return moved


@pytest.mark.long
def test_the_light_turns_by_dragging_its_picture(window, page, lights, dragged):
    """Its picture moves with the hand, and is then that of the turned map."""
    final(window)
    page.wait_for_selector(".tron-panorama")
    dragged(page, ".tron-panorama", -60)
    wide, place = page.locator(".tron-panorama").evaluate(
        "box => [box.clientWidth, parseFloat(box.style.backgroundPositionX)]"
    )
    turn = window.studio.wished.turn
    assert turn == pytest.approx(360 * 60 / wide, abs=2)
    assert place == pytest.approx(-60, abs=2)
    columns = lights["east"].image.shape[1]
    turned = lights["east"].rotated(360 * round(-place / wide * columns) / columns).baked().image
    moved = np.roll(lights["east"].image, round(place / wide * columns), axis=1)
    np.testing.assert_allclose(turned, moved, atol=1e-4)
    assert page.complaints == []


@pytest.mark.long
def test_the_divider_is_dragged_and_goes(window, page, dragged):
    alone = final(window)
    page.get_by_text("Compare", exact=True).first.click()
    page.get_by_role("combobox", name="Left side").click()
    page.get_by_role("option", name="light: west").click()
    page.wait_for_selector(".tron-divider")
    wide = page.locator("canvas").first.bounding_box()["width"]
    dragged(page, ".tron-divider", -40)
    both, wish = final(window), window.studio.wished
    assert (wish.left, wish.left_light) == ("light", "west")
    assert wish.divider == pytest.approx(0.5 - 40 / wide, abs=0.02)
    column = round(wish.divider * both.shape[1])
    assert (both[:, column - 1 : column + 1] == 255).all()
    change = np.abs(both.astype(int) - alone).mean((0, 2))
    assert change[: column - 2].mean() > 4 * change[column + 2 :].mean()
    page.get_by_role("combobox", name="Left side").click()
    page.get_by_role("option", name="nothing").click()
    np.testing.assert_array_equal(final(window), alone)
    assert page.locator(".tron-divider").count() == 0
    assert page.complaints == []


@pytest.mark.long
def test_a_camera_path_is_kept_played_and_filmed(window, page, tmp_path):
    final(window)
    page.get_by_text("Camera path", exact=True).first.click()
    page.get_by_role("button", name="Keep this view").click()
    time.sleep(0.5)
    page.mouse.move(150, 500)
    page.mouse.down()
    for step in range(10):
        page.mouse.move(150 + 8 * step, 500)
        time.sleep(0.1)
    page.mouse.up()
    time.sleep(1)
    page.get_by_role("button", name="Keep this view").click()
    window._filming._seconds.value = 2.0
    time.sleep(0.5)
    path = window._filming.path()
    assert len(path) == 48
    assert np.linalg.norm(path[0].position - path[-1].position) > 0.1
    (client,) = window._server.get_clients().values()
    page.get_by_role("button", name="Play").click()
    seen, hidden = [], []
    for step in range(40):
        time.sleep(0.1)
        seen.append(np.array(client.camera.position))
        hidden.append(not window._filming._way.visible)
        if step == 5:
            window._filming._say()  # drawn anew amid playing, as when its seconds change
    distances = np.linalg.norm(np.array(seen) - path[0].position, axis=1)
    assert distances.min() < 0.1
    np.testing.assert_allclose(client.camera.position, path[-1].position, atol=1e-3)
    assert (any(hidden), hidden[-1]) == (True, False)
    final(window)
    page.get_by_text("Save", exact=True).first.click()
    page.get_by_role("button", name="Film").click()
    page.wait_for_selector("text=tron-relight scene=")
    _, *words = shlex.split(window.saving.told)
    film = check(compose_recipe("conf.relight", Relight, words), Relight)
    assert film.cameras == tmp_path / "saved" / "path-001.json"
    assert film.cameras is not None
    cameras = read_cameras(film.cameras, *film.shaped().size)
    assert len(cameras) == 48
    np.testing.assert_allclose(cameras[20].world_to_camera, path[20].world_to_camera, atol=1e-6)
    assert page.complaints == []


def test_views_of_other_sizes_join_the_path(window, scene):
    """Framed as the first: what is at the top and bottom edge stays there."""
    first = Camera.around(scene, azimuth_deg=10, width=96, height=80)
    other = Camera.around(scene, azimuth_deg=90, width=200, height=60)
    window._filming.keep(first)
    assert window._filming.path() == []
    window._filming.keep(other)
    path = window._filming.path()
    assert {(each.width, each.height) for each in path} == {(96, 80)}
    np.testing.assert_allclose(path[-1].position, other.position)
    rows = [2 * np.arctan(each.height / 2 / each.fy) for each in (path[-1], other)]
    assert rows[0] == pytest.approx(rows[1])
    window._filming._step(SimpleNamespace(target=SimpleNamespace(value="Drop last"), client=None))
    assert window._filming.path() == []


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
    assert len(window.objects.numbers) == 4


@pytest.mark.long
def test_clicks_and_shift_clicks_cut_an_object_out(window, scene):
    """And the tools for objects have it: its list names it, and it is chosen."""
    camera = Camera.around(scene.upright(), azimuth_deg=30, distance=2, width=192, height=160)

    def click(at: np.ndarray, shift: bool) -> None:
        x, y = camera.project(at[None])[0][0]
        window._pick(camera, int(x), int(y), shift)

    panel, ball = window._cutting, scene.means[scene.object_id == BALL]
    click(ball.mean(0), False)
    assert window.objects.chosen == BALL, "clicks choose objects as long as they do not select"
    panel._on.value = True
    click(ball.mean(0), False)
    assert window.studio.wished.marked.inside
    assert "one of each" in panel._words.content
    click(np.array([1.2, -1.2, 0]), True)
    click(ball.mean(0), True)
    assert panel._words.content == "That is inside already."
    click(np.array([-1.2, 1.2, 0]), True)
    panel._take_back()
    assert len(window.studio.wished.marked.outside) > 0
    assert "1 inside, 1 outside" in panel._words.content
    panel._separate()
    (edit,) = window.studio.wished.edits
    assert isinstance(edit, Separate)
    assert (edit.object, window.objects.chosen) == (4, 4)
    assert window.studio.wished.marked is None
    cut = window.studio.ask(lambda stage: stage.session.scene.object_id == 4).result(60)
    assert cut[scene.object_id == BALL].mean() > 0.95
    window.history.undo()
    assert window.objects.numbers.keys() == {
        name for name in window.objects.numbers if not name.startswith("4 ")
    }


def test_a_port_in_use_is_said():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(TronError, match=f"cannot listen on 127.0.0.1:{port}: Address already in use"):
            require_free_port("127.0.0.1", port)


def test_files_are_saved_under_free_names_in_the_folder_alone(window, tmp_path: Path):
    names = [window.saving.path("scene", ".ply") for _ in range(2)]
    names[0].touch()
    names.append(window.saving.path("scene", ".ply"))
    assert [str(each.relative_to(tmp_path / "saved")) for each in names] == [
        *("scene-001.ply", "scene-001.ply"),
        "scene-002.ply",
    ]
