"""Surfels from G-buffers, on surfaces whose every ray is known in closed form."""

import dataclasses
import tracemalloc

import numpy as np
import pytest

from tron.cameras import Camera
from tron.color import linear_to_srgb
from tron.errors import TronError
from tron.gaussians import initialize, samples
from tron.gaussians.fields import FIELDS
from tron.gaussians.harmonics import dc_to_rgb
from tron.gaussians.initialize import GBufferView, surfels_from_gbuffers
from tron.gaussians.scene import neighbour_distances
from tron.seeds import generator

CENTRE, RADIUS = np.array([0.0, 0.0, 0.6]), 0.6
SIZE = 96


def albedo(points: np.ndarray) -> np.ndarray:
    return 0.5 + 0.35 * np.sin(points * [2.0, 3.0, 4.0] + [0.0, 1.0, 2.0])


def view(position, *, rgb=False, sphere=True, size=SIZE) -> GBufferView:
    """A sphere on the plane z = 0, or the plane alone, by closed-form ray casting in float64."""
    camera = Camera.look_at(position, [0, 0, 0.4], fov_deg=40, width=size, height=size)
    origin, d = np.asarray(position, float), camera.rays().astype(float)
    plane = np.where(d[..., 2] < 0, -origin[2] / d[..., 2], np.inf)
    plane = np.where(np.abs(origin + plane[..., None] * d)[..., :2].max(-1) < 2.0, plane, np.inf)
    b = d @ (origin - CENTRE)
    under = b * b - ((origin - CENTRE) ** 2).sum() + RADIUS**2
    ball = np.where((under > 0) & sphere, -b - np.sqrt(np.maximum(under, 0)), np.inf)
    t = np.minimum(plane, ball)
    valid = np.isfinite(t)
    points = origin + np.where(valid, t, 0)[..., None] * d
    normal = np.where((ball < plane)[..., None], (points - CENTRE) / RADIUS, [0.0, 0.0, 1.0])
    color = albedo(points)
    return GBufferView(
        camera=camera,
        position=points,
        normal=normal,
        base_color=color,
        roughness=np.where(ball < plane, 0.2, 0.8),
        metallic=np.where(ball < plane, 1.0, 0.0),
        rgb=1 - color if rgb else None,
        valid=valid,
        object_id=np.where(ball < plane, 7, 3),
    )


def ring(count=8, **options) -> list[GBufferView]:
    angles = np.arange(count) * 2 * np.pi / count
    heights = np.where(np.arange(count) % 2, 1.2, 3.0)
    return [view((4 * np.cos(a), 4 * np.sin(a), h), **options) for a, h in zip(angles, heights)]


@pytest.fixture(scope="module")
def scene():
    return surfels_from_gbuffers(ring(), count=4000)


def test_the_count_is_the_one_asked_for(scene):
    assert len(scene) == pytest.approx(4000, rel=0.01)
    assert len(surfels_from_gbuffers(ring(3), count=500)) == pytest.approx(500, rel=0.02)


def test_fewer_samples_than_surfels_give_one_surfel_each():
    few = surfels_from_gbuffers([view((4, 0, 2), size=8)], count=1000)
    assert len(few) == int(view((4, 0, 2), size=8).valid.sum())


def test_the_floor_is_one_sheet(scene):
    floor = scene.object_id == 3
    assert floor.sum() > 1000
    np.testing.assert_allclose(scene.means[floor, 2], 0, atol=1e-6)
    np.testing.assert_allclose(scene.normals()[floor], [[0, 0, 1]] * floor.sum(), atol=1e-5)


def test_rounding_does_not_split_a_flat_floor_in_two(monkeypatch):
    rng = generator(0, "test", "rounding")
    views = ring(4, sphere=False)
    for seen in views:
        seen.position[..., 2] += rng.uniform(-1e-7, 1e-7, seen.valid.shape)

    def closest(scene):
        """Distances to the nearest surfel that are typical of the closest twentieth, in spacings."""
        return np.quantile(neighbour_distances(scene.means, neighbours=1), 0.05) / scene.spacing

    assert closest(surfels_from_gbuffers(views, count=1000)) > 0.4
    monkeypatch.setattr(samples, "GRID_SHIFT", np.zeros(3))
    assert closest(surfels_from_gbuffers(views, count=1000)) < 0.2  # the law can fail


def test_the_sphere_is_where_it_is_and_faces_outwards(scene):
    ball = scene.object_id == 7
    from_centre = scene.means[ball] - CENTRE
    radii = np.linalg.norm(from_centre, axis=1)
    assert np.abs(radii - RADIUS).max() < 0.25 * scene.spacing
    cosine = (scene.normals()[ball] * from_centre).sum(1) / radii
    angles = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.mean(angles) < 1.0
    assert np.max(angles) < 5.0


def test_materials_and_colours_are_recovered(scene):
    ball = scene.object_id == 7
    np.testing.assert_allclose(scene.roughness, np.where(ball, 0.2, 0.8), atol=1e-6)
    np.testing.assert_allclose(scene.metallic, np.where(ball, 1.0, 0.0), atol=1e-6)
    assert np.abs(scene.base_color - albedo(scene.means)).mean() < 0.01
    np.testing.assert_allclose(dc_to_rgb(scene.sh[:, 0]), linear_to_srgb(scene.base_color), atol=1e-5)
    assert (scene.sh[:, 1:] == 0).all()


def test_radiance_of_the_views_becomes_the_harmonics():
    scene = surfels_from_gbuffers(ring(4, rgb=True), count=2000)
    np.testing.assert_allclose(dc_to_rgb(scene.sh[:, 0]), 1 - scene.base_color, atol=1e-5)


def test_scales_follow_the_spacing(scene):
    sigma = scene.scales()
    assert np.median(sigma) == pytest.approx(0.4 * scene.spacing, rel=1e-5)
    assert sigma.max() <= 0.4 * 3 * scene.spacing * 1.0001
    np.testing.assert_allclose(scene.opacities(), 0.99, atol=1e-6)
    assert scene.kernel_degree == 4
    # Area law: the surfels of a surface of area A at density M / A are about sqrt(A / M) apart.
    area = 16 + 4 * np.pi * RADIUS**2
    assert scene.spacing == pytest.approx(np.sqrt(area / len(scene)), rel=0.15)


def test_the_order_of_views_does_not_matter(scene):
    other = surfels_from_gbuffers(ring()[::-1], count=4000)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(other, name), getattr(scene, name), atol=1e-5)


def test_merging_beyond_the_memory_bound_changes_little(scene, monkeypatch):
    monkeypatch.setattr(initialize, "_SAMPLES_AT_ONCE", 10_000)
    monkeypatch.setattr(initialize, "_FINE", 2)
    bounded = surfels_from_gbuffers(ring(), count=4000)
    assert len(bounded) == pytest.approx(4000, rel=0.01)
    assert bounded.spacing == pytest.approx(scene.spacing, rel=0.05)
    ball = bounded.object_id == 7
    assert np.abs(np.linalg.norm(bounded.means[ball] - CENTRE, axis=1) - RADIUS).max() < 0.25 * scene.spacing
    assert np.abs(bounded.base_color - albedo(bounded.means)).mean() < 0.01


def test_thin_walls_keep_their_two_sides():
    # The same points seen from above and from below: two surfels back to back, never one with a mean normal.
    above = view((4, 0, 2), sphere=False)
    below = dataclasses.replace(above, normal=-above.normal, base_color=above.base_color * 0)
    scene = surfels_from_gbuffers([above, below], count=1000)
    up = scene.normals()[:, 2]
    np.testing.assert_allclose(np.abs(up), 1, atol=1e-5)
    assert (up > 0).sum() == pytest.approx((up < 0).sum(), rel=0.02)
    assert (scene.base_color[up < 0] == 0).all()
    # Neither side's surfels shrink because the other side is near.
    assert np.median(scene.scales()) == pytest.approx(
        np.median(surfels_from_gbuffers([above], count=500).scales()), rel=0.1
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"valid": np.zeros((SIZE, SIZE), bool)}, "no view sees any surface"),
        ({"roughness": np.zeros((2, 2))}, "roughness of view 0 has shape"),
        ({"position": np.full((SIZE, SIZE, 3), np.nan)}, "position of view 0 is not finite"),
        ({"normal": np.ones((SIZE, SIZE, 3))}, "normals of view 0 are not unit"),
        ({"object_id": np.full((SIZE, SIZE), -1)}, "object_id of view 0"),
    ],
)
def test_broken_views_are_refused(change, words):
    with pytest.raises(TronError, match=words):
        surfels_from_gbuffers([dataclasses.replace(view((4, 0, 2)), **change)], count=100)


def test_rgb_in_only_some_views_is_refused():
    with pytest.raises(TronError, match="1 of 2 views have rgb"):
        surfels_from_gbuffers([view((4, 0, 2)), view((4, 0, 2), rgb=True)], count=100)
    with pytest.raises(TronError, match="no views"):
        surfels_from_gbuffers([], count=100)


def test_views_may_come_one_by_one_and_none_is_kept(scene):
    """Ten times as many views take no more memory than their samples' bound, and give the same surfels."""
    streamed = surfels_from_gbuffers(iter(ring()), count=4000)
    for field in dataclasses.fields(scene):
        np.testing.assert_array_equal(getattr(streamed, field.name), getattr(scene, field.name))


def test_memory_does_not_grow_with_the_number_of_views(monkeypatch):
    monkeypatch.setattr(initialize, "_SAMPLES_AT_ONCE", 20_000)
    few = view((4, 0, 2))
    peaks = []
    for count in (8, 32):
        tracemalloc.start()
        surfels_from_gbuffers((dataclasses.replace(few) for _ in range(count)), count=200)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]
    pixels = 32 * few.valid.size
    assert peaks[1] < initialize.sample_bytes(200, pixels) + 200 * few.valid.size < 200 * pixels
