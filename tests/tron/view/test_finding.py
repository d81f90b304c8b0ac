"""A window that shows guessed materials changes over to those that were found, with its edits."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from examples.stage import BALL, RING
from tron.cameras import Camera
from tron.editing import Material, Move, Selection
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.view.finding import MaterialSearch
from tron.view.stage import Stage
from tron.view.window import FOUND, Window

PATIENCE = 900
EDITS = (
    Material(select=Selection(object=BALL), metallic=1.0, roughness=0.1),
    Move(select=Selection(object=RING), by=(0.4, 0.0, 0.2)),
)


def test_another_scene_is_shown_with_the_edits_of_the_one_before(open_studio, scene, camera):
    """Bitwise as a studio that was opened with it."""
    other = replace(scene, base_color=np.clip(1 - scene.base_color, 0, 1))
    with open_studio(threads=1) as (studio, shown):
        studio.look(0, camera)
        studio.wish(edits=EDITS)
        before = shown.final(studio, camera)
        studio.reopen(lambda: (other, None))
        shown.until(lambda: shown.pictures[-1].refined == 1 and shown.pictures[-1] is not before)
        after = shown.pictures[-1]
    with open_studio(scene=other, threads=1) as (fresh, there):
        fresh.wish(edits=EDITS)
        fresh.look(0, camera)
        expected = there.final(fresh, camera)
    assert np.abs(before.image.astype(int) - after.image).mean() > 1
    np.testing.assert_array_equal(after.image, expected.image)


def test_a_scene_that_cannot_be_opened_is_a_notice_and_the_one_before_goes_on(open_studio, camera):
    def missing():
        raise TronError("there is no such file")

    with open_studio(threads=1) as (studio, shown):
        studio.look(0, camera)
        shown.final(studio, camera)
        studio.reopen(missing)
        shown.until(lambda: shown.notices)
        studio.wish(light="west")
        shown.final(studio, camera)
    assert shown.notices == ["there is no such file"]


def test_what_is_drawn_of_the_scene_before_is_no_picture_of_the_other(
    open_studio, scene, camera, monkeypatch
):
    """Also where the last piece of a picture was under way when the other scene came."""
    other = replace(scene, base_color=np.clip(1 - scene.base_color, 0, 1))
    display, came = Stage.display, threading.Event()
    with open_studio(threads=1) as (studio, shown):

        def shown_late(stage, *given):
            image = display(stage, *given)
            if not came.is_set():
                came.set()
                studio.reopen(lambda: (other, None))
            return image

        monkeypatch.setattr(Stage, "display", shown_late)
        studio.wish(quality="preview")
        studio.look(0, camera)
        shown.until(lambda: shown.pictures and shown.pictures[-1].refined == 1)
        found = studio.ask(lambda stage: stage.session.scene).result(60)
        last = shown.pictures[-1].image
    with open_studio(scene=other, threads=1) as (fresh, there):
        fresh.wish(quality="preview")
        fresh.look(0, camera)
        there.until(lambda: there.pictures and there.pictures[-1].refined == 1)
    assert found is other
    np.testing.assert_array_equal(last, there.pictures[-1].image)


def plain(scene: GaussianScene, file: Path) -> Path:
    """A file of the scene as other programs have it: colours alone, normals without a sign."""
    guessed = replace(scene, materials_guessed=True, oriented=False)
    guessed.save(file)
    return file


@pytest.mark.long
def test_the_window_changes_over_when_the_search_has_found_materials(
    scene, lights, variant, tmp_path, free_port
):
    """And keeps them beside the scan, where tron-relight looks."""
    file = plain(scene, tmp_path / "scan.ply")
    lights["east"].save(tmp_path / "east.exr")
    search = MaterialSearch(file, {"apart": tmp_path, "up": (0, 0, 1)}, variant=variant, threads=1)
    guessed = GaussianScene.load(file)
    window = Window(
        guessed, file, {"east": tmp_path / "east.exr"}, {}, tmp_path / "saved", "127.0.0.1", free_port(),
        Camera.around(guessed.upright(), azimuth_deg=30, width=48, height=40), search=search, searching=True,
        variant=variant, threads=1,
    )  # fmt: skip
    try:
        ends = time.monotonic() + PATIENCE
        while window._finder.disabled and window._materials.content != FOUND:
            assert time.monotonic() < ends
            time.sleep(0.5)
        assert window._materials.content == FOUND
        shown = window._ask(lambda stage: stage.session.scene)
    finally:
        window.close()
    kept = GaussianScene.load(tmp_path / "scan.materials.ply")
    assert not shown.materials_guessed
    np.testing.assert_array_equal(shown.base_color, kept.base_color)


@pytest.mark.long
def test_a_search_that_fails_says_why(tmp_path):
    said: list[str] = []
    ended = threading.Event()
    search = MaterialSearch(tmp_path / "gone.ply", {})

    def done(why: str) -> None:
        said.append(why)
        ended.set()

    search.begin(lambda *_: None, done)
    assert ended.wait(300)
    search.close()
    assert len(said) == 1
    assert "gone.ply" in said[0]
