"""Laws of surfels from depth maps, on a plane and a ball whose depths and normals are known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.color import srgb_to_linear
from tron.gaussians.harmonics import SH_C0
from tron.reconstruction.geometry.initial import normals_of_depth, surfels_from_depth
from tron.reconstruction.settings import InitialSettings

RADIUS, FLOOR = 0.8, -1.0
RED = np.array([0.8, 0.3, 0.2])


def ball_and_floor(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance (H, W) and true normal (H, W, 3) of a ball above a floor, and where it is the ball."""
    rays, eye = camera.rays().astype(np.float64), camera.position
    b = rays @ eye
    inside = b * b - eye @ eye + RADIUS**2
    ball = np.where(inside > 0, -b - np.sqrt(np.maximum(inside, 0)), np.inf)
    down = np.minimum(rays[..., 2], -1e-9)
    floor = np.where(rays[..., 2] < -1e-6, (FLOOR - eye[2]) / down, np.inf)
    depth = np.minimum(ball, floor)
    known = depth < 12
    depth = np.where(known, depth, 0)
    normal = np.where((ball <= floor)[..., None], (eye + depth[..., None] * rays) / RADIUS, (0.0, 0, 1))
    return depth, normal * known[..., None], (ball <= floor) & known


def views(size: int = 64) -> list[View]:
    made = []
    for i in range(6):
        turn = 2 * np.pi * i / 6
        eye = (4 * np.cos(turn), 4 * np.sin(turn), 1.5)
        camera = Camera.look_at(eye, (0, 0, -0.2), fov_deg=45, width=size, height=size)
        depth, _, ball = ball_and_floor(camera)
        image = np.where(ball[..., None], RED, 0.5)
        made.append(View(str(i), camera, image, "display", depth=depth, mask=(depth > 0).astype(np.float32)))
    return made


def off_the_surface(points: np.ndarray) -> np.ndarray:
    return np.minimum(np.abs(np.linalg.norm(points, axis=1) - RADIUS), np.abs(points[:, 2] - FLOOR))


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos((a * b).sum(-1).clip(-1, 1)))


def test_the_normals_of_a_plane_are_its_own_to_a_degree_and_face_the_camera() -> None:
    for eye in ((2.0, 1.0, 3.0), (2.0, 1.0, -3.0)):  # from above and from below
        camera = Camera.look_at(eye, (0.3, 0.2, 0), fov_deg=50, width=48, height=40)
        depth = -eye[2] / camera.rays().astype(np.float64)[..., 2]
        view = View("plane", camera, np.zeros((40, 48, 3)), "display", depth=depth)
        normal = normals_of_depth(view, view.read("depth"))
        assert angles_deg(normal, np.array([0, 0, np.sign(eye[2])])).max() < 1
        np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-5)


def test_the_normals_of_a_ball_are_right_to_a_degree_where_pixels_are_dense() -> None:
    view = views(256)[0]
    depth, truth, ball = ball_and_floor(view.camera)
    normal = normals_of_depth(view, depth)
    facing = -(truth * view.camera.rays()).sum(-1)
    error = angles_deg(normal, truth)
    # One-sided differences: half a pixel of curvature, larger towards the silhouette.
    assert error[ball & (facing > 0.6)].mean() < 1
    assert ((normal * view.camera.rays()).sum(-1)[depth > 0] <= 0).all()


def test_no_normal_leans_over_an_edge() -> None:
    """The floor's normals hold up to the ball's silhouette, where the depth jumps."""
    view = views(128)[0]
    depth, truth, ball = ball_and_floor(view.camera)
    error = angles_deg(normals_of_depth(view, depth), truth)
    floor = (depth > 0) & ~ball
    near = floor & (np.roll(ball, 2, 0) | np.roll(ball, -2, 0) | np.roll(ball, 2, 1) | np.roll(ball, -2, 1))
    near[:2] = near[-2:] = near[:, :2] = near[:, -2:] = False
    assert near.sum() > 50
    assert np.quantile(error[near], 0.9) < 1


def test_nothing_is_known_where_there_is_no_depth() -> None:
    view = views(32)[0]
    depth = np.zeros((32, 32), np.float32)
    assert not normals_of_depth(view, depth).any()
    depth[10, 10] = 2.0  # a lone pixel has a place and no slope
    assert not normals_of_depth(view, depth).any()


@pytest.mark.parametrize("degree", [2, 4])
def test_surfels_lie_on_the_surface_and_face_outwards(degree) -> None:
    capture = Capture(tuple(views()), up=np.array([0.0, 0, 1]))
    settings = InitialSettings(source="depth", count=1500, kernel_degree=degree)
    scene = surfels_from_depth(capture, settings, seed=0).validate()
    assert len(scene) == pytest.approx(1500, rel=0.05)
    assert scene.kernel_degree == degree
    # A surfel is the mean of the samples of its cell: on a ball a little inside.
    off = off_the_surface(scene.means.astype(np.float64))
    assert np.median(off) < 0.05 * scene.spacing
    assert np.quantile(off, 0.95) < 0.3 * scene.spacing
    on_ball = np.abs(np.linalg.norm(scene.means, axis=1) - RADIUS) < 0.02
    outward = (scene.normals()[on_ball] * scene.means[on_ball]).sum(1) / RADIUS
    assert np.quantile(outward, 0.05) > 0.97
    floor = np.abs(scene.means[:, 2] - FLOOR) < 0.02
    assert np.quantile(scene.normals()[floor][:, 2], 0.05) > 0.99


def test_surfels_have_the_colours_of_the_photos() -> None:
    scene = surfels_from_depth(Capture(tuple(views())), InitialSettings(count=1000), seed=0)
    on_ball = np.abs(np.linalg.norm(scene.means, axis=1) - RADIUS) < 0.02
    assert on_ball.sum() > 50
    shown = scene.sh[on_ball, 0] * SH_C0 + 0.5
    np.testing.assert_allclose(np.median(shown, axis=0), RED, atol=0.01)
    np.testing.assert_allclose(np.median(scene.base_color[on_ball], axis=0), srgb_to_linear(RED), atol=0.01)


def test_true_normals_and_materials_are_preferred() -> None:
    blue = np.array([0.1, 0.2, 0.9])
    told = []
    for view in views():
        normal = ball_and_floor(view.camera)[1]
        maps = {"base_color": np.broadcast_to(blue, (64, 64, 3)), "roughness": np.full((64, 64), 0.2)}
        told.append(replace(view, normal=normal, metallic=np.full((64, 64), 0.7), **maps))
    scene = surfels_from_depth(Capture(tuple(told)), InitialSettings(count=800), seed=0)
    np.testing.assert_allclose(scene.base_color, np.broadcast_to(blue, scene.base_color.shape), atol=1e-5)
    np.testing.assert_allclose(scene.roughness, 0.2, atol=1e-5)
    np.testing.assert_allclose(scene.metallic, 0.7, atol=1e-5)


def test_what_the_mask_hides_makes_no_surfels_and_held_out_views_make_none() -> None:
    made = views()
    only_ball = tuple(replace(v, mask=ball_and_floor(v.camera)[2].astype(np.float32)) for v in made)
    scene = surfels_from_depth(Capture(only_ball), InitialSettings(count=500), seed=0)
    assert np.linalg.norm(scene.means, axis=1).max() < RADIUS + 0.05
    one = Capture(tuple(made), test=frozenset(v.name for v in made[1:]))
    seen = surfels_from_depth(one, InitialSettings(count=500), seed=0)
    eye = made[0].camera.position
    assert ((seen.normals() * (eye - seen.means)).sum(1) > 0).all()


def test_surfels_from_depth_repeat_by_seed() -> None:
    capture = Capture(tuple(views()))
    one, again, other = (surfels_from_depth(capture, InitialSettings(count=40), seed=s) for s in (0, 0, 1))
    np.testing.assert_array_equal(one.means, again.means)
    assert one.means.shape != other.means.shape or (one.means != other.means).any()
