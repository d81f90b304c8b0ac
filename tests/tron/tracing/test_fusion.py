"""Laws of the fusion: a ball comes back from its depth maps, noise averages out, masks carve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from tron.cameras import Camera
from tron.metrics import angular_error_deg
from tron.seeds import generator
from tron.tracing.fusion import DepthMap, DistanceField, consensus, empty_rays, fuse, pixel_footprint

RADIUS = 0.7


def ball_map(camera: Camera, noise: float = 0.0, index: int = 0) -> DepthMap:
    """The true depth of a ball about the origin, with noise."""
    rays = camera.rays().astype(np.float64)
    along = -(rays @ camera.position)
    inside = RADIUS**2 - (camera.position @ camera.position - along**2)
    depth = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), 0)
    depth += (depth > 0) * noise * generator(0, "ball", index).normal(size=depth.shape)
    known = depth > 0
    return DepthMap(camera, depth.astype(np.float32), known, empty_rays(known))


BallMaps = Callable[..., list[DepthMap]]


@pytest.fixture
def ball_maps(around: Callable[..., list[Camera]], variant: str) -> BallMaps:
    """Makes the depth maps of twelve views of the ball, with noise of a size."""

    def make(noise: float = 0.0) -> list[DepthMap]:
        return [ball_map(camera, noise, k) for k, camera in enumerate(around(12, size=64))]

    return make


def on_the_ball(count: int = 400, radius: float = RADIUS) -> np.ndarray:
    points = generator(0, "on the ball").normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def value_at(field: DistanceField, points: np.ndarray) -> np.ndarray:
    return np.array(field.sampler().at(mi.Point3f(points.T.astype(np.float32)))[0])


def field_of(maps: list[DepthMap]) -> DistanceField:
    field = fuse(maps, pixel_footprint(maps), 4, 160)
    assert field is not None
    return field


def test_the_field_of_a_ball_is_the_distance_to_it(ball_maps: BallMaps) -> None:
    field = field_of(ball_maps())

    def median(off: float) -> float:
        return field.reach * float(np.median(value_at(field, on_the_ball(radius=RADIUS + off))))

    assert abs(median(0)) < 0.006
    # Distances are measured along rays, which meet the ball at a slant: they are too long, never too short.
    assert 1 < median(0.04) / 0.04 < 2
    assert 1 < median(-0.04) / -0.04 < 2
    assert field.value.flat[0] == 1  # where nobody saw anything


def test_views_agree_on_depth_and_normals_of_a_ball(ball_maps: BallMaps) -> None:
    maps = ball_maps()
    for each, (depth, normal) in zip(maps, consensus(field_of(maps), maps, sigma=1.0), strict=True):
        known = depth > 0
        assert known.sum() > 0.8 * (each.depth > 0).sum()
        assert np.median(np.abs(depth - each.depth)[known]) < 0.01
        points = each.camera.position + depth[..., None] * each.camera.rays()
        radial = points / np.linalg.norm(points, axis=-1, keepdims=True).clip(1e-9)
        assert angular_error_deg(normal, radial, known) < 4


def test_a_surface_is_not_found_from_behind(ball_maps: BallMaps) -> None:
    """A view whose depth is that of the ball's far side, which the others see from outside."""
    maps = ball_maps()
    camera, rays = maps[0].camera, maps[0].camera.rays().astype(np.float64)
    along = -(rays @ camera.position)
    inside = RADIUS**2 - (camera.position @ camera.position - along**2)
    far = np.where(inside > 0, along + np.sqrt(np.maximum(inside, 0)), 0)
    field = field_of(maps)
    for depth, most in ((maps[0].depth, 1.0), (far, 0.02)):
        found, normal = consensus(field, [replace(maps[0], depth=depth)], sigma=1.0)[0]
        share = (found > 0).sum() / (depth > 0).sum()
        assert most - 0.2 < share <= most
        assert not normal[found == 0].any()


@pytest.mark.parametrize(
    ("slope", "weight", "known"), [(0.2, 0.6, True), (0.1, 0.6, False), (0.2, 0.4, False)]
)
def test_flat_fields_and_those_that_hardly_anyone_saw_have_no_surface(
    variant: str,
    slope: float,
    weight: float,
    known: bool,
) -> None:
    """A wall at x = 4, seen along x; ``slope`` is the field's, of a full one's."""
    x = np.broadcast_to(np.arange(9.0)[:, None, None], (9, 9, 9))
    field = DistanceField(np.zeros(3), 1.0, 4.0, slope * (4 - x) / 4, np.full((9, 9, 9), weight))
    camera = Camera.look_at((-5, 4, 4), (4, 4, 4), fov_deg=5, width=4, height=4)
    view = DepthMap(camera, np.full((4, 4), 8.6), np.ones((4, 4)))
    depth, normal = consensus(field, [view], sigma=0)[0]
    assert ((depth > 0) == known).all()
    expected = [-1.0, 0, 0] if known else [0.0, 0, 0]
    np.testing.assert_allclose(normal, np.broadcast_to(expected, (4, 4, 3)), atol=1e-5)


def test_what_has_no_weight_does_not_count_and_smoothing_is_a_weighted_mean(ball_maps: BallMaps) -> None:
    maps = ball_maps()
    wrong = replace(maps[0], depth=0.9 * maps[0].depth, weight=np.zeros_like(maps[0].weight), empty=None)
    fields = [fuse(some, 0.03, 4, 160) for some in ([wrong, *maps[1:]], maps[1:])]
    assert fields[0] is not None
    assert fields[1] is not None
    np.testing.assert_allclose(fields[0].value, fields[1].value, rtol=1e-6)
    draw = generator(0, "weights")
    weight, value = (draw.uniform(0.5, 3, (9, 9, 9)).astype(np.float32) for _ in range(2))
    even = DistanceField(np.zeros(3), 1.0, 4.0, np.full_like(value, 0.5), weight).smoothed(1.0)
    np.testing.assert_allclose(even.value, 0.5, rtol=1e-5)
    # In the middle, by hand: a Gaussian of one voxel, cut off at four.
    offsets = np.arange(9) - 4
    kernel = np.exp(-0.5 * offsets**2)
    kernel = np.einsum("i,j,k->ijk", *[kernel / kernel.sum()] * 3)
    smooth = DistanceField(np.zeros(3), 1.0, 4.0, value, weight).smoothed(1.0)
    w = kernel * weight.astype(np.float64)
    assert float(smooth.weight[4, 4, 4]) == pytest.approx(w.sum(), rel=1e-5)
    assert float(smooth.value[4, 4, 4]) == pytest.approx((w * value).sum() / w.sum(), rel=1e-5)


def test_noise_averages_out_over_the_views(ball_maps: BallMaps) -> None:
    truth, noisy = ball_maps(), ball_maps(noise=0.03)
    errors = []
    for each, exact, (depth, _) in zip(noisy, truth, consensus(field_of(noisy), noisy, 1.0), strict=True):
        known = (depth > 0) & (exact.depth > 0)
        errors.append([np.sqrt(np.square(d - exact.depth)[known].mean()) for d in (depth, each.depth)])
    after, before = np.mean(errors, 0)
    assert after < 0.5 * before


def test_masks_carve_what_depth_invents(ball_maps: BallMaps) -> None:
    maps = ball_maps()
    camera = maps[0].camera
    # One view sees a wall in front of everything; all the others see nothing there.
    wall = replace(maps[0], depth=np.full_like(maps[0].depth, 2.9), weight=np.ones_like(maps[0].depth))
    wall = replace(wall, empty=None)
    probe = (camera.position + 2.9 * camera.rays()[8, 8])[None]
    carved, kept = (
        fuse([wall, *others], 0.03, 4, 160)
        for others in (maps[1:], [replace(each, empty=None) for each in maps[1:]])
    )
    assert carved is not None
    assert kept is not None
    assert value_at(carved, probe)[0] > 0.5
    assert abs(value_at(kept, probe)[0]) < 0.3


def test_nothing_seen_is_no_field(ball_maps: BallMaps) -> None:
    maps = [replace(each, weight=np.zeros_like(each.weight)) for each in ball_maps()]
    assert fuse(maps, 0.03, 4, 160) is None
    assert pixel_footprint(maps) == 0


def test_a_wide_scene_has_larger_voxels_and_no_more_of_them(ball_maps: BallMaps) -> None:
    field = fuse(ball_maps(), 1e-4, 4, 40)
    assert field is not None
    assert max(field.value.shape) <= 42


def test_closing_fills_narrow_pits_and_leaves_wide_ones_and_edges() -> None:
    """The block below z = 15 of 30 voxels, from x = 5 on, with pits five deep, four and twelve wide."""
    x, y, z = np.meshgrid(*[np.arange(30.0)] * 3, indexing="ij")
    block = np.maximum(z - 15, 5 - x)
    for middle, half in ((10.5, 2.0), (21.5, 6.0)):
        pit = np.maximum(np.maximum(np.abs(x - middle), np.abs(y - 15)) - half, 10 - z)
        block = np.maximum(block, -pit)
    value = np.clip(block / 4, -1, 1).astype(np.float32)
    field = DistanceField(np.zeros(3), 1.0, 4.0, value, np.ones_like(value))
    closed = field.closed(2).value
    narrow, wide = (10, 15, 12), (21, 15, 12)
    assert value[narrow] > 0 > closed[narrow]
    assert closed[wide] > 0
    assert np.array_equal(closed[3:8], value[3:8]), "the edge at x = 5 has moved"
    unseen = replace(field, weight=np.zeros_like(value))
    assert np.array_equal(unseen.closed(2).value, value)
