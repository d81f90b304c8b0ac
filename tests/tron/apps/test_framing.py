"""Automatic framing: what is looked at, that it fits into the image, and cameras from files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tron.cameras import Camera
from tron.framing import find_subject, upright
from tron.seeds import generator
from tron.trajectories import plan_cameras, turn_cameras

VIEW = {"width": 64, "height": 48, "fov_deg": 50.0}


def test_the_subject_is_what_stands_on_the_floor(ball_on_floor):
    subject = find_subject(ball_on_floor(half=4.0))
    np.testing.assert_allclose(subject.centre, [0, 0, 0.55], atol=0.08)
    assert subject.radius == pytest.approx(0.5, abs=0.08)


def test_strays_do_not_move_the_subject(ball_on_floor):
    scene = ball_on_floor()
    before = find_subject(scene)
    scene.means[:5] = generator(0, "test", "strays").uniform(50, 900, (5, 3))
    np.testing.assert_allclose(find_subject(scene).centre, before.centre, atol=0.05)


def test_a_leaf_that_stands_out_belongs_to_the_subject_and_a_floater_does_not(ball_on_floor):
    """Each holds half a percent of the ball's surfels, fewer than strays may be."""
    scene = ball_on_floor()
    ball = np.flatnonzero(scene.object_id == 1)
    moved = generator(0, "test", "leaf").permutation(ball)[: round(0.01 * len(ball))]
    leaf, floater = np.array_split(moved, 2)
    scene.means[leaf] = np.linspace((0, 0, 1), (0, 0, 1.2), len(leaf))
    scene.means[floater] = np.linspace((0.68, 0, 0.5), (0.7, 0, 0.5), len(floater))
    top = find_subject(scene).points.max(axis=0)
    assert top[2] > 1.1
    assert top[0] < 0.6


def test_without_a_floor_everything_is_the_subject(ball_on_floor):
    scene = ball_on_floor()
    keep = scene.object_id == 1
    for name in ("means", "quats"):
        setattr(scene, name, getattr(scene, name)[keep])
    subject = find_subject(scene)
    np.testing.assert_allclose(subject.centre, [0, 0, 0.5], atol=0.02)
    assert subject.radius == pytest.approx(0.5, abs=0.02)


def test_a_floor_alone_is_the_subject(ball_on_floor):
    scene = ball_on_floor()
    for name in ("means", "quats"):
        setattr(scene, name, getattr(scene, name)[scene.object_id == 0])
    assert find_subject(scene).radius > 1.5


@pytest.mark.parametrize("trajectory", ["orbit", "spiral", "oscillating", "still"])
@pytest.mark.parametrize("size", [(64, 48), (48, 64)])
def test_every_camera_sees_the_whole_subject(ball_on_floor, trajectory, size):
    scene = ball_on_floor()
    width, height = size
    cameras = plan_cameras(scene, trajectory, 9, width=width, height=height, fov_deg=50)
    assert len(cameras) == 9
    ball = scene.means[scene.object_id == 1]
    for camera in cameras:
        pixels, depth = camera.project(ball)
        assert (depth > 0).all()
        assert ((pixels > 0) & (pixels < [width, height])).all()
        extent = (np.ptp(pixels, axis=0) / [width, height]).max()
        assert extent > 0.6  # and not as a dot


def test_framing_does_not_depend_on_where_and_how_large_the_scene_is(ball_on_floor):
    scene, moved = ball_on_floor(), ball_on_floor()
    moved.means = moved.means * 7 + np.array([100, -40, 12], np.float32)
    moved.spacing *= 7
    for a, b in zip(plan_cameras(scene, "orbit", 3, **VIEW), plan_cameras(moved, "orbit", 3, **VIEW)):
        np.testing.assert_allclose(a.world_to_camera[:3, :3], b.world_to_camera[:3, :3], atol=1e-6)
        np.testing.assert_allclose(b.position, a.position * 7 + [100, -40, 12], atol=0.01)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1), (0, -1, 0), (0.6, 0, -0.8), (1e-9, 0, -1)])
def test_upright_takes_up_to_z_by_a_rotation(up):
    up = np.array(up) / np.linalg.norm(up)
    turn = upright(up)
    np.testing.assert_allclose(turn @ up, [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(turn) == pytest.approx(1)


def test_turned_cameras_see_the_turned_world_as_before(ball_on_floor):
    scene = ball_on_floor()
    cameras = plan_cameras(scene, "orbit", 2, **VIEW)
    rotation = Rotation.from_euler("xyz", [0.4, 2.0, -1.0]).as_matrix()
    turned = turn_cameras(cameras, rotation)
    for before, after in zip(cameras, turned):
        np.testing.assert_allclose(
            after.project(scene.means @ rotation.T)[0], before.project(scene.means)[0], atol=1e-3
        )


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0.6, 0, 0.8)])
def test_a_camera_around_a_scene_is_the_one_that_stands_still(ball_on_floor, up):
    upright_scene = ball_on_floor()
    scene = upright_scene.rotated(upright(np.array(up, float)).T)
    np.testing.assert_allclose(scene.up, up, atol=1e-6)
    image = {"width": 64, "height": 48, "fov_deg": 50}
    camera = Camera.around(scene, **image)
    (still,) = plan_cameras(scene, "still", 1, **image)
    np.testing.assert_allclose(camera.world_to_camera, still.world_to_camera, atol=1e-9)
    assert camera.up @ scene.up > 0.8
    np.testing.assert_allclose(scene.upright().up, (0, 0, 1), atol=1e-6)
    pixels, depth = Camera.around(scene, azimuth_deg=120, **image).project(scene.means[scene.object_id == 1])
    assert (depth > 0).all()
    assert ((pixels > 0) & (pixels < (64, 48))).all(1).mean() > 0.97


def test_a_scene_that_is_upright_is_left_alone(ball_on_floor):
    scene = ball_on_floor()
    assert scene.upright() is scene
