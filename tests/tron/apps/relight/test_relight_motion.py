"""tron-relight motion=...: things, lights and shadows move, and a film that was cut short goes on."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from tron.color import to_display
from tron.gaussians.edit import moved
from tron.gaussians.scene import GaussianScene
from tron.io.images import read_image
from tron.shading.environments.environment import EnvironmentMap

STILL = ("trajectory=still", "fps=2", "checkpoint=null", "buffers=[lit,position,normal]", "exposure=1")


@pytest.fixture
def film(relight, scene_path, light_path, tmp_path):
    """Films a motion from above the lamp's side; gives the folder of frames."""

    def film(motion: dict, *given: str, name: str = "out", scene: Path = scene_path, frames: int = 3) -> Path:
        path = tmp_path / "motion.yaml"
        path.write_text(yaml.safe_dump(motion))
        out = tmp_path / name
        base = [f"scene={scene}", f"environment={light_path}", f"output_dir={out}", f"frames={frames}"]
        assert relight(*base, f"motion={path}", *STILL, *given) == 0
        return out / "frames"

    return film


def ball(*keys: dict) -> dict:
    return {"objects": [{"select": {"object": 1}, "keys": list(keys)}]}


UP = ball({"time": 0}, {"time": 1, "by": [-0.3, 0.2, 0.4]})


def test_the_last_frame_is_that_of_the_scene_moved_there(film, relight, scene_path, light_path, tmp_path):
    """Its shadow too: but for the noise of the few rays, which the hierarchy's order draws."""
    frames = film(UP)
    scene = GaussianScene.load(scene_path)
    there = tmp_path / "there.ply"
    moved(scene, scene.object_id == 1, translation=np.array([-0.3, 0.2, 0.4])).save(there)
    nothing = ball({"time": 0, "by": [0, 0, 0]})
    cameras = f"cameras={tmp_path / 'out' / 'relight.json'}"
    wanted = film(nothing, cameras, name="wanted", scene=there)
    lit = [to_display(read_image(each / "0002.lit.exr"), 1) for each in (frames, wanted)]
    np.testing.assert_allclose(
        read_image(frames / "0002.position.exr"), read_image(wanted / "0002.position.exr"), atol=1e-5
    )
    assert -10 * np.log10(np.square(lit[0] - lit[1]).mean()) > 36
    first = to_display(read_image(frames / "0000.lit.exr"), 1)
    assert -10 * np.log10(np.square(first - lit[1]).mean()) < 26


def test_a_film_goes_on_where_it_was_cut_short(film):
    frames = film(UP, "threads=1")
    kept = {path.name: path.read_bytes() for path in sorted(frames.glob("*.exr"))}
    for path in frames.glob("000[12].*"):
        path.unlink()
    film(UP, "threads=1")
    assert {path.name: path.read_bytes() for path in sorted(frames.glob("*.exr"))} == kept


def test_a_proxy_moves_with_what_it_stands_for(film):
    """Of a scene that needs none the pictures are nearly those without, the shadow's new place included."""
    plain, proxied = film(UP), film(UP, "proxy=always", name="proxied")
    for n in (0, 2):
        lit = [to_display(read_image(each / f"000{n}.lit.exr"), 1) for each in (plain, proxied)]
        assert -10 * np.log10(np.square(lit[0] - lit[1]).mean()) > 27
    moved_by = [to_display(read_image(proxied / f"000{n}.lit.exr"), 1) for n in (0, 2)]
    assert -10 * np.log10(np.square(moved_by[0] - moved_by[1]).mean()) < 25


def test_what_stands_still_is_traced_once(film, monkeypatch):
    """Between frames where nothing moves there is no other relighter, and no other bake."""
    from tron.relighting import Relighter

    baked = []
    under = Relighter.under
    monkeypatch.setattr(Relighter, "under", lambda *given, **more: baked.append(1) or under(*given, **more))
    film(ball({"time": 0.5}, {"time": 1, "by": [0, 0, 0.1]}), frames=5)  # frames at 0, 0.5, 1, 1.5 and 2 s
    assert len(baked) == 2


def test_a_stop_is_twice_the_light_and_a_fade_the_mean_of_two(film, light_path, tmp_path):
    other = tmp_path / "even.exr"
    EnvironmentMap.constant([0.2, 0.4, 0.6]).save(other)
    keys = [{"time": 0}, {"time": 0.5, "stops": 1}, {"time": 1}]
    frames = film({"light": keys}, "background=[0,0,0]")
    first, bright, last = (read_image(frames / f"000{n}.lit.exr") for n in range(3))
    ratio = bright[first > 0.01] / first[first > 0.01]
    np.testing.assert_allclose(np.quantile(ratio, [0.05, 0.5, 0.95]), 2, rtol=0.02)  # rays choose by floats
    np.testing.assert_allclose(last, first, rtol=0.1, atol=1e-3)
    keys = [{"time": 0}, {"time": 1, "environment": str(other)}]
    fade = film({"light": keys}, "background=[0,0,0]", "quality=final", name="fade")
    first, half, last = (read_image(fade / f"000{n}.lit.exr") for n in range(3))
    assert np.abs(first.mean() - last.mean()) > 0.03
    np.testing.assert_allclose(half.mean((0, 1)), 0.5 * (first + last).mean((0, 1)), rtol=0.03)


def test_a_light_that_turns_by_keys_turns_as_rotation_does(film, tmp_path):
    by_keys = film({"light": [{"time": 0}, {"time": 1, "rotation": 90}]}, frames=3)
    report = json.loads((by_keys.parent / "relight.json").read_text())
    assert report["rotations"][-1] == 90
    alone = film(ball({"time": 0}), "rotation=90", name="alone", frames=1)
    np.testing.assert_array_equal(
        read_image(by_keys / "0002.position.exr"), read_image(alone / "0000.position.exr")
    )
    lit = [to_display(read_image(path), 1) for path in (by_keys / "0002.lit.exr", alone / "0000.lit.exr")]
    assert -10 * np.log10(np.square(lit[0] - lit[1]).mean()) > 36


def test_a_thing_falls_in_a_scene_that_is_not_z_up(film, ball_on_floor, tmp_path):
    """The file's up is y; gravity follows it, and what is filmed stands upright."""
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    scene = ball_on_floor()
    path = tmp_path / "y_up.ply"
    raised = moved(scene, scene.object_id == 1, translation=np.array([0, 0, 0.5])).rotated(turn)
    np.testing.assert_allclose(raised.up, [0, 1, 0], atol=1e-6)
    raised.save(path)
    frames = film({"fall": {"objects": [1]}}, "up=[0,1,0]", "width=64", "height=64", scene=path, frames=5)
    heights = []
    for n in (0, 4):
        position, normal = (read_image(frames / f"000{n}.{name}.exr") for name in ("position", "normal"))
        heights.append(position[np.linalg.norm(normal, axis=-1) > 0.9][:, 2].max())
    assert heights[0] - heights[1] == pytest.approx(0.5, abs=0.05)


def test_a_network_is_exposed_for_the_light_of_the_first_frame(film, light_path):
    """A dark beginning is no dark guidance: the map's own exposure is 32 times too little."""
    report = json.loads((film({"light": [{"time": 0, "stops": -5}]}).parent / "relight.json").read_text())
    bright = EnvironmentMap.load(light_path).exposure()
    assert report["guidance_exposure"] == pytest.approx(32 * bright, rel=0.01)


def test_it_says_how_many_frames_show_all_of_a_motion(film, caplog):
    with caplog.at_level("INFO"):
        film(ball({"time": 0}, {"time": 4, "by": [0, 0, 1]}), frames=1)
    assert "the motion lasts 4 s, the film 0 s: frames=9 shows all of it" in caplog.text


@pytest.mark.parametrize(
    ("motion", "said"),
    [
        ("objects: [", "not YAML"),
        ("light: [{time: 0, environment: nowhere.hdr}]", "file not found"),
        ("objects: [{select: {object: 9}, keys: [{time: 0}]}]", "object"),
    ],
)
def test_a_mistake_is_one_line_and_writes_nothing(
    relight, scene_path, light_path, tmp_path, capsys, motion, said
):
    path, out = tmp_path / "motion.yaml", tmp_path / "out"
    path.write_text(motion)
    base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={out}", f"motion={path}"]
    assert relight(*base, "frames=1") == 2
    assert said in capsys.readouterr().err
    assert not out.exists()


def test_a_missing_motion_is_one_line(relight, scene_path, light_path, tmp_path, capsys):
    base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={tmp_path / 'out'}"]
    assert relight(*base, f"motion={tmp_path / 'none.yaml'}") == 2
    assert "none.yaml" in capsys.readouterr().err
