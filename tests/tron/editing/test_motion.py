"""Motions: keys are met, nothing overshoots, bodies fall by Newton's law, and mistakes are one line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from examples.stage import BALL, FLOOR, RING
from tron.editing import Move, Selection, Views
from tron.editing.motion import Fall, Motion
from tron.editing.moving import in_motion
from tron.errors import TronError
from tron.gaussians.edit import moved, removed, scaled
from tron.gaussians.scene import GaussianScene

G = 9.81


def motion_of(**given) -> Motion:
    return Motion.model_validate(given)


def path_of(**given) -> dict:
    return {"select": {"object": BALL}, **given}


def centre(scene: GaussianScene, number: int = BALL) -> np.ndarray:
    return scene.means[scene.object_id == number].astype(np.float64).mean(0)


def test_a_key_is_the_edit_that_says_the_same(scene):
    keys = [{"time": 0}, {"time": 1, "by": [0.3, 0, 0.1], "turn": 40}, {"time": 2, "turn": -400}]
    moving = in_motion(motion_of(objects=[path_of(keys=keys)]), scene, 2)
    there = Selection(object=BALL)
    first, last = Move(select=there, by=(0.3, 0, 0.1), turn=40), Move(select=there, turn=-400)
    for time, edit in ((1, first), (2, last), (9, last)):
        wanted, found = edit.apply(scene, Views()), moving.at(time)
        for name in ("means", "quats", "sh"):
            np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=2e-6)
    assert moving.at(0) is scene


def test_between_keys_nothing_overshoots_and_turns_are_counted(scene):
    keys = [{"time": 1}, {"time": 2, "by": [1, 0, 0], "turn": 720}, {"time": 3, "by": [1, 0, 0], "turn": 720}]
    moving = in_motion(motion_of(objects=[path_of(keys=keys)]), scene, 3)
    start = centre(scene)
    shifts = np.array([centre(moving.at(t)) - start for t in np.linspace(0, 4, 33)])
    assert np.all(np.diff(shifts[:, 0]) >= -1e-6)
    np.testing.assert_allclose(shifts[[0, 8, 16, -1], 0], [0, 0, 1, 1], atol=1e-5)
    angles = [Rotation.from_matrix(moving.poses[0].at(t)[0]).magnitude() for t in np.linspace(1, 2, 33)]
    assert np.sum(np.diff(np.sign(np.diff(angles))) != 0) == 3  # to a half turn, back, there and back again


def test_a_motion_is_of_its_own_world(scene):
    """In a scene that stands turned, the motion goes where the turned motion would go."""
    turn = Rotation.from_euler("xyz", [90, 20, 5], degrees=True).as_matrix()
    keys = [{"time": 1, "by": [0.3, 0.2, 0.1], "turn": 50}]
    box = {"low": [-9, -9, 0.05], "high": [9, 9, 9]}
    motion = motion_of(objects=[{"select": {"object": BALL, "box": box}, "keys": keys, "axis": [1, 2, 3]}])
    plain = in_motion(motion, scene, 1).at(1)
    found = in_motion(motion, scene.rotated(turn), 1, turn).at(1)
    np.testing.assert_allclose(found.means, plain.means @ turn.T, atol=1e-5)


def test_other_surfels_go_with_those_nearest_to_them(scene):
    moving = in_motion(motion_of(objects=[path_of(keys=[{"time": 0, "by": [0, 0, 1]}])]), scene, 0)
    proxy = replace(scene, means=scene.means + np.float32(1e-3))
    shift = moving.follow(proxy, 0).means - proxy.means
    clear = scene.means[:, 2] > 0.1  # what touches the floor may stay with it
    np.testing.assert_allclose((shift - [0, 0, 1])[(scene.object_id == BALL) & clear], 0, atol=1e-5)
    assert not shift[(scene.object_id == RING) & clear].any()


def test_light_turns_brightens_and_fades():
    keys = [{"time": 1}, {"time": 2, "rotation": 90, "stops": 1, "environment": "b.hdr"}, {"time": 3}]
    motion = motion_of(light=keys)
    assert motion.light_at(0).maps == ((None, 1.0),)
    half = motion.light_at(1.5)
    assert dict(half.maps) == pytest.approx({None: 0.5, Path("b.hdr"): 0.5})
    assert motion.light_at(2).rotation == 90
    assert motion.light_at(2).factor == 2
    assert motion.light_at(5) == motion.light_at(3)
    assert motion.light_at(3).maps == ((Path("b.hdr"), 1.0),)  # the map of the key before


def lifted(scene: GaussianScene, height: float) -> GaussianScene:
    return moved(scene, scene.object_id == BALL, translation=np.array([0, 0, height]))


def test_a_ball_falls_by_newtons_law_and_comes_to_rest_on_the_floor(scene):
    start = lifted(scene, 1.0)
    moving = in_motion(motion_of(fall={"objects": [BALL], "start": 0.5}), start, 4)
    begin, rest = centre(start)[2], centre(scene)[2]
    for time in (0.0, 0.5, 0.7, 0.9):
        fallen = 0.5 * G * max(time - 0.5, 0) ** 2
        assert begin - centre(moving.at(time))[2] == pytest.approx(fallen, rel=0.02, abs=1e-5)
    assert centre(moving.at(4))[2] == pytest.approx(rest, abs=0.05)
    np.testing.assert_allclose(centre(moving.at(4))[2], centre(moving.at(3.9))[2], atol=0.002)
    assert not (moving.at(4).means - start.means)[scene.object_id != BALL].any()


def test_a_pushed_ball_rolls_with_five_sevenths_of_its_speed(scene):
    """Whatever the friction is, once it slides no more: its moment of inertia says so."""
    fall = {"objects": [BALL], "push": {BALL: [-3, 0, 0]}, "friction": 0.4}
    moving = in_motion(motion_of(fall=fall), scene, 0.5)
    ways = [centre(moving.at(time)) - centre(scene) for time in (0.02, 0.3, 0.45)]
    np.testing.assert_allclose(ways[0] / 0.02, [-3, 0, 0], atol=0.2)
    np.testing.assert_allclose((ways[2] - ways[1]) / 0.15, [-15 / 7, 0, 0], atol=0.15)
    turned = [Rotation.from_matrix(moving.poses[0].at(time)[0]) for time in (0.3, 0.4)]
    rolled = (turned[1] * turned[0].inv()).as_rotvec() / 0.1
    np.testing.assert_allclose(rolled * 0.4, [0, -15 / 7, 0], atol=0.3)


def test_what_is_met_is_pushed_along(scene):
    away = (centre(scene, RING) - centre(scene)) * [1, 1, 0]
    fall = {"objects": [BALL, RING], "push": {BALL: (3 * away / np.linalg.norm(away)).tolist()}}
    moving = in_motion(motion_of(fall=fall), scene, 0.5)
    assert (centre(moving.at(0.5), RING) - centre(scene, RING)) @ away > 0.1


def test_the_unit_of_length_does_not_matter(scene):
    """A scene a hundred times as large, under a hundred times the gravity, falls alike."""
    small = lifted(scene, 0.5)
    large = replace(scaled(small, np.ones(len(small), bool), 100, np.zeros(3)), spacing=100 * small.spacing)
    falls = (Fall(objects=(BALL,)), Fall(objects=(BALL,), gravity=100 * G))
    one, other = (in_motion(Motion(fall=fall), each, 1) for fall, each in zip(falls, (small, large)))
    np.testing.assert_allclose(centre(other.at(1)) / 100, centre(one.at(1)), atol=2e-3)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "nothing moves"),
        ({"object": []}, "unknown key 'object'.*did you mean 'objects'"),
        ({"objects": [path_of(keys=[{"time": 1}, {"time": 1}])]}, "1 s comes after 1 s"),
        ({"objects": [path_of(keys=[])]}, "objects.0.keys"),
        ({"objects": [path_of(keys=[{"by": [0, 0, 1]}])]}, "'objects.0.keys.0.time' has no value"),
        ({"objects": [path_of(keys=[{"time": 0, "by": [0, 0, float("nan")]}])]}, "wrong value for"),
        ({"light": [{"time": 0, "stop": 1}]}, "unknown key 'light.0.stop'.*did you mean 'stops'"),
        ({"fall": {"objects": [BALL], "push": {RING: [1, 0, 0]}}}, f"object {RING} is pushed"),
        ({"fall": {"objects": [BALL, BALL]}}, "twice"),
        ({"objects": [path_of(keys=[{"time": 1e308}])]}, "wrong value for 'objects.0.keys.0.time'"),
        ({"objects": [path_of(keys=[{"time": 0}, {"time": 1e-320}])]}, "comes after"),
        ({"fall": {"objects": [BALL], "push": {BALL: [1e39, 0, 0]}}}, "wrong value for"),
        ([1], "no motion found"),
    ],
)
def test_a_mistake_in_a_file_is_one_line(tmp_path, given, said):
    path = tmp_path / "motion.yaml"
    path.write_text(yaml.safe_dump(given))
    with pytest.raises(TronError, match=said) as caught:
        Motion.read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["light: [{time: 2024-13-45}]", "objects: &a [*a]", "light: [{time: 0b_}]"])
def test_odd_yaml_is_one_line(tmp_path, text):
    path = tmp_path / "motion.yaml"
    path.write_text(text)
    with pytest.raises(TronError):
        Motion.read(path)


def test_what_moves_by_keys_carries_nothing_and_floaters_neither(scene):
    """The ball leaves from under the ring; a column of transparent surfels stands in its way."""
    over = moved(scene, scene.object_id == RING, translation=centre(scene) - centre(scene, RING) + [0, 0, 2])
    away = [path_of(keys=[{"time": 0, "by": [0, 30, 0]}])]
    rests = [
        centre(in_motion(motion_of(fall={"objects": [RING]}, **more), over, 1).at(0.6), RING)[2]
        for more in ({}, {"objects": away})
    ]
    assert rests[0] - rests[1] > 0.3
    fog = replace(over, opacity_logits=np.where(over.object_id == BALL, -8, over.opacity_logits).astype("f4"))
    low = centre(in_motion(motion_of(fall={"objects": [RING]}), fog, 1).at(0.6), RING)[2]
    assert low == pytest.approx(rests[1], abs=0.01)


def test_things_fall_on_the_ground_that_is_shown(scene):
    """Without a floor of their own; its height is the plane's."""
    alone = removed(scene, scene.object_id == FLOOR)
    with pytest.raises(TronError, match="nothing stands below"):
        in_motion(motion_of(fall={"objects": [BALL, RING]}), alone, 3)
    moving = in_motion(motion_of(fall={"objects": [BALL, RING]}), lifted(alone, 1), 3, ground=-0.5)
    assert centre(moving.at(3))[2] == pytest.approx(-0.1, abs=0.05)  # its radius is 0.4


@pytest.mark.parametrize(
    "select",
    [{"grow": {"at": [3]}}, {"any": [{"grow": {"view": 0, "at": [[3, 4]]}}]}],
    ids=["number", "pixel"],
)
def test_pixels_select_nothing_in_a_motion(scene, select):
    with pytest.raises(TronError, match="pixels, clicks and masks"):
        in_motion(motion_of(objects=[{"select": select, "keys": [{"time": 0}]}]), scene, 1)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"objects": [{"select": {"object": 77}, "keys": [{"time": 0}]}]}, "object.* 77|no surfel"),
        ({"objects": [path_of(keys=[{"time": 0}])] * 2}, "path 2 of objects.*moves already|moves already"),
        ({"fall": {"objects": [77]}}, "no object 77"),
        ({"fall": {"objects": [BALL]}, "objects": [path_of(keys=[{"time": 0}])]}, "moves already"),
    ],
)
def test_a_motion_that_the_scene_has_not_is_one_line(scene, given, said):
    with pytest.raises(TronError, match=said):
        in_motion(motion_of(**given), scene, 1)


def test_what_is_a_sheet_does_not_fall(scene):
    flat = replace(
        scene, means=np.where((scene.object_id == BALL)[:, None], [0, 0, 1], scene.means).astype("f4")
    )
    with pytest.raises(TronError, match="enclose no space"):
        in_motion(motion_of(fall={"objects": [BALL]}), flat, 1)


def test_bodies_that_begin_within_one_another_are_named(scene, caplog):
    inside = moved(scene, scene.object_id == BALL, translation=centre(scene, RING) - centre(scene))
    in_motion(motion_of(fall={"objects": [BALL, RING]}), inside, 0)
    assert f"object {BALL} and object {RING} begin within one another" in caplog.text
    caplog.clear()
    in_motion(motion_of(fall={"objects": [BALL, RING]}), lifted(scene, 1), 0)
    assert not caplog.text
