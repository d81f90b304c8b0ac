"""Flow is where a point of the scene goes: closed forms of planes, turns and moves, and round trips."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tron.cameras import Camera
from tron.errors import TronError
from tron.flow import both_see, flow, warp

WIDTH, HEIGHT = 40, 30
AHEAD = Camera.look_at((0, 0, 0), (0, 1, 0), fov_deg=50, width=WIDTH, height=HEIGHT)


def shifted(camera: Camera, by) -> Camera:
    """The camera moved by a vector of its own frame."""
    matrix = np.array(camera.world_to_camera)
    matrix[:3, 3] -= by
    return replace(camera, world_to_camera=matrix)


def turned(camera: Camera, degrees: float) -> Camera:
    """The camera turned about its own y axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return replace(camera, world_to_camera=matrix @ camera.world_to_camera)


def centres(camera: Camera) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1)


def plane(camera: Camera, normal, offset: float) -> np.ndarray:
    """(H, W) distance of the plane normal . X = offset along the camera's rays, 0 where it is not met."""
    rays = camera.rays().astype(np.float64)
    with np.errstate(divide="ignore"):
        distance = (offset - camera.position @ normal) / (rays @ normal)
    return np.where(np.isfinite(distance) & (distance > 0), distance, 0.0)


def test_a_wall_ahead_moves_by_focal_length_times_shift_over_its_distance():
    wall = plane(AHEAD, np.array([0.0, 1.0, 0.0]), 4.0)
    found = flow(wall, AHEAD, shifted(AHEAD, (0.3, -0.2, 0.0)))
    np.testing.assert_allclose(found[..., 0], -AHEAD.fx * 0.3 / 4, atol=1e-5)
    np.testing.assert_allclose(found[..., 1], AHEAD.fy * 0.2 / 4, atol=1e-5)


def test_going_ahead_spreads_a_wall_from_the_middle():
    wall = plane(AHEAD, np.array([0.0, 1.0, 0.0]), 4.0)
    found = flow(wall, AHEAD, shifted(AHEAD, (0.0, 0.0, 1.0)))
    expected = (centres(AHEAD) - (AHEAD.cx, AHEAD.cy)) * (4 / 3 - 1)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("distance", [0.0, 1.0, 700.0])
def test_a_turn_moves_everything_by_the_homography_whatever_its_distance(distance):
    other = turned(AHEAD, 6.0)
    relative = other.world_to_camera[:3, :3] @ AHEAD.world_to_camera[:3, :3].T
    homography = other.intrinsics @ relative @ np.linalg.inv(AHEAD.intrinsics)
    moved = np.concatenate([centres(AHEAD), np.ones((HEIGHT, WIDTH, 1))], -1) @ homography.T
    expected = moved[..., :2] / moved[..., 2:] - centres(AHEAD)
    np.testing.assert_allclose(flow(np.full((HEIGHT, WIDTH, 1), distance), AHEAD, other), expected, atol=1e-9)


def test_there_and_back_ends_where_it_began():
    """Flow of a plane is a homography, so the flow back is known at every place, not at pixels alone."""
    normal = np.array([0.1, 0.9, 0.3]) / np.linalg.norm([0.1, 0.9, 0.3])
    other = shifted(turned(AHEAD, 5.0), (0.2, 0.1, 0.3))
    there = flow(plane(AHEAD, normal, 3.0), AHEAD, other)
    finer = other.resized(16 * WIDTH, 16 * HEIGHT)
    back = flow(plane(finer, normal, 3.0), finer, AHEAD.resized(16 * WIDTH, 16 * HEIGHT)) / 16
    landed = warp(back, 16 * (there + centres(AHEAD)) - centres(AHEAD))
    seen = np.isfinite(landed).all(-1)
    assert seen.mean() > 0.5
    np.testing.assert_allclose((there + landed)[seen], 0.0, atol=2e-3)


def test_a_picture_on_a_plane_is_warped_onto_itself():
    normal, offset = np.array([0.2, 0.9, -0.2]) / np.linalg.norm([0.2, 0.9, -0.2]), 3.0
    other = shifted(turned(AHEAD, 4.0), (0.15, 0.0, 0.1))

    def painted(camera):
        points = camera.position + camera.rays() * plane(camera, normal, offset)[..., None]
        return np.stack([np.sin(points[..., 0]), np.cos(points[..., 2]), points[..., 0]], -1)

    seen = both_see(plane(AHEAD, normal, offset), AHEAD, plane(other, normal, offset), other)
    found = warp(painted(other), flow(plane(AHEAD, normal, offset), AHEAD, other))
    inside = np.isfinite(found).all(-1)
    np.testing.assert_array_equal(seen, inside)
    assert 0.7 < seen.mean() < 1
    np.testing.assert_allclose(found[seen], painted(AHEAD)[seen], atol=3e-3)


def test_what_stands_before_a_wall_hides_the_strip_that_parallax_says():
    """A screen at 2 over the left half, a wall at 4: the screen hides f s (1/2 - 1/4) pixels of it."""
    across = np.array([0.0, 1.0, 0.0])
    shift = 0.5

    def seen_by(camera):
        points = camera.position + camera.rays() * plane(camera, across, 2.0)[..., None]
        return np.where(points[..., 0] < 0, plane(camera, across, 2.0), plane(camera, across, 4.0))

    other = shifted(AHEAD, (-shift, 0.0, 0.0))
    seen = both_see(seen_by(AHEAD), AHEAD, seen_by(other), other)
    wall_place = centres(AHEAD)[..., 0] + AHEAD.fx * shift / 4
    edge = AHEAD.cx + AHEAD.fx * shift / 2
    right = centres(AHEAD)[..., 0] > AHEAD.cx
    assert not seen[right & (wall_place < edge - 1)].any(), "what the screen hides is not seen"
    assert seen[right & (wall_place > edge + 1) & (wall_place < WIDTH - 1)].all()
    assert (right & (wall_place < edge - 1)).any(), "there is something to hide"


def test_what_moved_is_found_where_it_went_and_nowhere_else():
    wall = plane(AHEAD, np.array([0.0, 1.0, 0.0]), 4.0)
    moving = np.zeros((HEIGHT, WIDTH), bool)
    moving[10:20, 10:20] = True
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("y", 20, degrees=True).as_matrix()
    motion[:3, 3] = (0.4, 0.0, 0.2)
    found = flow(wall, AHEAD, AHEAD, moving, motion)
    np.testing.assert_allclose(found[~moving], 0.0, atol=1e-6)
    points = (AHEAD.position + AHEAD.rays() * wall[..., None])[moving]
    expected, _ = AHEAD.project(points @ motion[:3, :3].T + motion[:3, 3])
    np.testing.assert_allclose((found + centres(AHEAD))[moving], expected, atol=1e-4)


def test_the_same_view_sees_all_of_itself_and_no_flow():
    depth = np.where(np.arange(WIDTH) < 20, 2.0, 0.0) * np.ones((HEIGHT, 1))
    np.testing.assert_allclose(flow(depth, AHEAD, AHEAD), 0.0, atol=1e-9)
    assert both_see(depth, AHEAD, depth, AHEAD)[:, np.r_[0:19, 21:WIDTH]].all()


def test_what_is_behind_the_other_camera_has_no_place_in_it():
    depth = np.full((HEIGHT, WIDTH), 2.0)
    away = turned(AHEAD, 180.0)
    assert np.isnan(flow(depth, AHEAD, away)).all()
    assert not both_see(depth, AHEAD, depth, away).any()


def test_sizes_that_differ_are_told():
    depth = np.full((HEIGHT, WIDTH), 2.0)
    for call in (
        lambda: flow(depth[:-1], AHEAD, AHEAD),
        lambda: both_see(depth, AHEAD, depth[:, 1:], AHEAD),
        lambda: flow(depth, AHEAD, AHEAD, moving=depth > 1),
    ):
        with pytest.raises(TronError, match=r"pixels|motion"):
            call()
