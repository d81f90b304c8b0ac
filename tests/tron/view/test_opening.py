"""Windows in a notebook: one beside another, and where their frames look."""

import socket

import numpy as np
import pytest

from examples.stage import make_scene
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.relighting import Relighter
from tron.shading.environments.environment import EnvironmentMap
from tron.view import show


@pytest.fixture
def given(tmp_path, variant):
    EnvironmentMap(np.ones((8, 16, 3), np.float32)).save(tmp_path / "sky.exr")
    named = {"relighter": Relighter(make_scene(0.3)), "lights": tmp_path / "sky.exr"}
    return named | {"output_dir": tmp_path / "saved"}


def answers(address: str) -> bool:
    host, port = address.removeprefix("http://").split(":")
    try:
        socket.create_connection((host, int(port)), timeout=5).close()
    except OSError:
        return False
    return True


def test_a_second_window_beside_one_that_was_not_closed(given):
    first = show(**given)
    second = show(**given)
    try:
        assert answers(first.window.address)
        assert answers(second.window.address)
        assert first.window.address != second.window.address
        taken = int(first.window.address.rpartition(":")[2])
        with pytest.raises(TronError, match="Address already in use"):
            show(**given, port=taken)
    finally:
        second.close()
        first.close()


def test_a_relighter_shows_itself(given, tmp_path):
    """Without a file of the scene or of the light; what it writes is what it was given."""
    scene, sky = make_scene(0.3), EnvironmentMap.load(given["lights"])
    folder = tmp_path / "kept"
    shown = show(Relighter(scene), {"sky": sky, "dusk": sky}, output_dir=folder)
    try:
        assert answers(shown.window.address)
        (kept,) = folder.iterdir()
        np.testing.assert_array_equal(GaussianScene.load(kept / "scene.ply").means, scene.means)
        assert sorted(path.name for path in kept.iterdir()) == ["dusk.exr", "scene.ply", "sky.exr"]
        known = shown.window.studio.ask(lambda stage: len(stage.session.scene)).result(60)
        assert known == len(scene)
    finally:
        shown.close()
    assert not answers(shown.window.address)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"lights": {"../sky": None}}, "the name of a light is that of its file"),
        ({"lights": "nowhere"}, "there is no such folder"),
        ({"light": "dusk"}, "no map is called dusk"),
    ],
)
def test_what_cannot_be_shown_is_one_line(given, changed, said):
    with pytest.raises(TronError, match=said):
        show(**{**given, **changed})


def test_without_viser_it_says_what_to_install(given, monkeypatch):
    monkeypatch.setattr("tron.cli.installation._is_installed", lambda name: name != "viser")
    with pytest.raises(TronError, match=r"the viewer needs viser.*pip install 'tron-relight\[view\]'"):
        show(**given)


def test_a_frame_looks_at_this_machine_where_all_may_look(given):
    shown = show(**given, host="0.0.0.0")
    try:
        assert 'src="http://localhost:' in shown._repr_html_()
        assert answers(shown.window.address)
    finally:
        shown.close()
