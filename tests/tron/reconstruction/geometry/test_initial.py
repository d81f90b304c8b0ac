"""Laws of the first surfels: where cameras look, inside what masks leave, as wide as neighbours are apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.gaussians.harmonics import SH_C0
from tron.reconstruction.geometry.initial import beginning, extent_of, surfels_at
from tron.reconstruction.geometry.seen_space import random_points
from tron.reconstruction.settings import InitialSettings
from tron.seeds import generator


def photo(name: str, camera: Camera, mask: np.ndarray | None = None) -> View:
    return View(name, camera, np.full((camera.height, camera.width, 3), 0.5), "display", mask=mask)


def ring(
    count: int = 8, radius: float = 3.0, fov: float = 40.0, scale: int = 1, target=(0, 0, 0)
) -> list[View]:
    views = []
    for i in range(count):
        turn = 2 * np.pi * i / count
        eye = (radius * np.cos(turn), radius * np.sin(turn), 0.5 * (-1) ** i)
        camera = Camera.look_at(eye, target, fov_deg=fov, width=24 * scale, height=20 * scale)
        views.append(photo(str(i), camera))
    return views


def ball_mask(camera: Camera, centre: np.ndarray, radius: float) -> np.ndarray:
    """(H, W) 1 where the ray through the pixel centre meets the ball: the distance of a point to a line."""
    offset = centre - camera.position
    along = camera.rays().astype(np.float64) @ offset
    return ((offset @ offset - along**2) < radius**2).astype(np.float32)


def within(camera: Camera, points: np.ndarray) -> np.ndarray:
    pixels, depth = camera.project(points)
    return (depth > 0) & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)


def test_the_extent_is_the_median_distance_to_the_median_centre() -> None:
    eyes = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [100, 0, 0.0]])
    ahead = eyes + np.array([0, 1, 0])
    cameras = [Camera.look_at(e, a, fov_deg=40, width=8, height=8) for e, a in zip(eyes, ahead)]
    views = [photo(str(i), camera) for i, camera in enumerate(cameras)]
    # The median centre is (2, 0, 0); distances 2, 1, 0, 1, 98; a stray camera counts no more than another.
    assert extent_of(views) == pytest.approx(1.1 * 1)


def test_cameras_that_turn_on_the_spot_are_refused_for_all_that_rounding_moves_them() -> None:
    eye = np.array([3.3, -7.7, 1.1])
    draws = generator(0, "turns").normal(size=(9, 3))
    cameras = [Camera.look_at(eye, eye + draw, fov_deg=40, width=8, height=8) for draw in draws]
    positions = np.stack([camera.position for camera in cameras])
    assert np.ptp(positions, axis=0).max() > 0  # else this would test nothing
    with pytest.raises(TronError, match="one place"):
        extent_of([photo(str(i), camera) for i, camera in enumerate(cameras)])


def test_a_small_world_has_an_extent_too() -> None:
    large, small = ring(), []
    for view in large:
        eye = 1e-6 * view.camera.position
        small.append(photo(view.name, Camera.look_at(eye, (0, 0, 0), fov_deg=40, width=8, height=8)))
    assert extent_of(small) == pytest.approx(1e-6 * extent_of(large), rel=1e-6)


def test_random_points_are_where_cameras_look_and_the_same_each_time() -> None:
    capture = Capture(tuple(ring(target=(0.3, 0, 0))))
    points = random_points(capture, 500, seed=0)
    assert points.shape == (500, 3)
    seen = np.sum([within(view.camera, points) for view in capture.views], axis=0)
    assert seen.min() >= 2
    np.testing.assert_array_equal(points, random_points(capture, 500, seed=0))
    assert not np.array_equal(points, random_points(capture, 500, seed=1))


def test_random_points_ignore_what_is_held_out() -> None:
    views = ring()
    capture = Capture(tuple(views), test=frozenset({"0", "3"}))
    train = Capture(tuple(view for view in views if view.name not in capture.test))
    np.testing.assert_array_equal(random_points(capture, 100, 0), random_points(train, 100, 0))


def test_random_points_fill_the_visual_hull_and_no_more() -> None:
    """The ball is 1/200 of the cameras' box; its hull is a little larger than itself."""
    centre, radius = np.array([0.2, -0.1, 0.1]), 0.4
    views = [replace(v, mask=ball_mask(v.camera, centre, radius)) for v in ring(12, fov=60, scale=6)]
    points = random_points(Capture(tuple(views)), 2000, seed=0)
    assert len(points) == 2000
    distance = np.linalg.norm(points - centre, axis=1)
    assert np.quantile(distance, 0.9) < 1.25 * radius
    # Uniform within: a ball of half the radius has an eighth of the volume of the ball.
    inner, whole = (distance < radius / 2).sum(), (distance < radius).sum()
    assert inner / whole == pytest.approx(1 / 8, rel=0.25)


def test_masks_that_hide_everything_leave_no_points() -> None:
    views = [replace(view, mask=np.zeros((20, 24))) for view in ring(4)]
    with pytest.raises(TronError, match="no part of space"):
        random_points(Capture(tuple(views)), 50, seed=0)


def test_cameras_that_diverge_have_something_in_front_of_them() -> None:
    views = []
    for i in range(6):
        turn = 2 * np.pi * i / 6
        out = np.array([np.cos(turn), np.sin(turn), 0])
        views.append(photo(str(i), Camera.look_at(out, 3 * out, fov_deg=90, width=24, height=20)))
    points = random_points(Capture(tuple(views)), 50, seed=0)
    seen = np.sum([within(view.camera, points) for view in views], axis=0)
    assert seen.min() >= 1


def brute_force_scale(points: np.ndarray) -> np.ndarray:
    distances = np.linalg.norm(points[:, None].astype(np.float64) - points, axis=2)
    nearest = np.sort(distances, axis=1)[:, 1:4]
    return np.sqrt((nearest**2).mean(axis=1))


def test_surfels_of_points_are_as_wide_as_their_neighbours_are_apart() -> None:
    capture = Capture(tuple(ring()))
    points = generator(0, "points").normal(size=(60, 3)).astype(np.float32) * 0.3
    scene = surfels_at(
        points, None, capture, InitialSettings(opacity=0.2, kernel_degree=4), seed=0
    ).validate()
    np.testing.assert_array_equal(scene.means, points)
    np.testing.assert_allclose(scene.scales(), brute_force_scale(points)[:, None].repeat(2, 1), rtol=1e-4)
    np.testing.assert_allclose(scene.opacities(), 0.2, rtol=1e-5)
    assert scene.kernel_degree == 4
    np.testing.assert_allclose(scene.sh[:, 0] * SH_C0 + 0.5, 0.5, atol=1e-6)  # grey
    assert not scene.sh[:, 1:].any()


def test_the_colours_of_points_come_back() -> None:
    capture = Capture(tuple(ring()), up=np.array([0.0, 1, 0]))
    rng = generator(0, "colours")
    points, colors = rng.normal(size=(40, 3)) * 0.3, rng.random((40, 3))
    scene = surfels_at(points, colors, capture, InitialSettings(), seed=0)
    np.testing.assert_allclose(scene.sh[:, 0] * SH_C0 + 0.5, colors, atol=1e-6)
    np.testing.assert_allclose(scene.base_color, srgb_to_linear(colors), atol=1e-6)
    np.testing.assert_array_equal(scene.up, (0, 1, 0))


def test_each_surfel_faces_a_camera_that_has_it_in_its_picture() -> None:
    capture = Capture(tuple(ring(6, fov=20)), test=frozenset({"2"}))
    points = random_points(capture, 200, seed=0)
    normals = surfels_at(points, None, capture, InitialSettings(), seed=0).normals()
    towards = []
    for view in capture.train_views:
        direction = view.camera.position - points
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        towards.append(((direction * normals).sum(1) > 1 - 1e-5) & within(view.camera, points))
    assert np.any(towards, axis=0).all()
    # And not all the same one: each of the five is faced by some.
    assert np.sum(towards, axis=1).min() > 10


def test_points_that_lie_on_one_another_make_surfels_too() -> None:
    points = np.repeat(generator(0, "twice").normal(size=(5, 3)) * 0.3, 6, axis=0)
    surfels_at(points, None, Capture(tuple(ring())), InitialSettings(), seed=0).validate()


def test_auto_takes_points_before_depth_and_depth_before_chance() -> None:
    views = ring()
    points = generator(0, "points").normal(size=(30, 3)).astype(np.float32) * 0.2
    with_depth = tuple(replace(v, depth=ball_mask(v.camera, np.zeros(3), 0.5) * 2.5) for v in views)
    settings = InitialSettings(count=100)
    from_points = beginning(Capture(with_depth, points=points), settings, 0).scene
    np.testing.assert_array_equal(from_points.means, points)
    from_depth = beginning(Capture(with_depth), settings, 0).scene
    assert np.linalg.norm(from_depth.means, axis=1).max() < 1
    assert from_depth.opacities().min() > 0.9
    by_chance = beginning(Capture(tuple(views)), settings, 0).scene
    np.testing.assert_array_equal(by_chance.means, random_points(Capture(tuple(views)), 100, 0))


def test_no_more_surfels_than_the_cap_to_begin_with() -> None:
    points = generator(0, "many").normal(size=(300, 3)).astype(np.float32) * 0.2
    colors = generator(1, "many").random((300, 3)).astype(np.float32)
    capture = Capture(tuple(ring()), points=points, point_colors=colors)
    scene = beginning(capture, InitialSettings(), 0, most=100).scene
    assert len(scene) == 100
    place = [int(np.flatnonzero((points == mean).all(1))[0]) for mean in scene.means]
    np.testing.assert_allclose(scene.sh[:, 0] * SH_C0 + 0.5, colors[place], atol=1e-6)
    np.testing.assert_allclose(scene.scales()[:, 0], brute_force_scale(scene.means), rtol=1e-4)
    again = beginning(capture, InitialSettings(), 0, most=100).scene
    np.testing.assert_array_equal(again.means, scene.means)
    assert len(beginning(Capture(tuple(ring())), InitialSettings(count=200), 0, most=70).scene) == 70


@pytest.mark.parametrize(
    ("source", "words"), [("points", "no points"), ("depth", "no training view has a depth")]
)
def test_a_source_that_is_not_there_is_said(source, words: str) -> None:
    with pytest.raises(TronError, match=words):
        beginning(Capture(tuple(ring())), InitialSettings(source=source), 0)


def test_three_points_are_too_few() -> None:
    capture = Capture(tuple(ring()), points=np.eye(3, dtype=np.float32))
    with pytest.raises(TronError, match="3 points are too few"):
        beginning(capture, InitialSettings(), 0)
