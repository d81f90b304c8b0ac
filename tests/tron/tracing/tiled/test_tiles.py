"""Tile lists with the camera among the surfels: what is seen is listed, and little else is."""

from __future__ import annotations

from collections import Counter

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tron import seeds
from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.tracing import SurfelTracer, reference
from tron.tracing.kernel import MIN_ALPHA, MIN_RESPONSE, T_MIN, SurfelRecords
from tron.tracing.tiled.tiles import TILE, build_tiles, tile_counts

pytestmark = pytest.mark.usefixtures("variant")

EDGE = 1e-4
"""Relative: so near to its edge, or so nearly edge-on, float32 may see a surfel otherwise than float64."""


def scene_of(means, normals, log_scales, opacity: float | np.ndarray = 0.9) -> GaussianScene:
    count = len(means)
    rng = seeds.generator(0, "tests", "tiles", count)
    return GaussianScene(
        means=means,
        quats=quats_from_normals(np.asarray(normals, float)),
        log_scales=log_scales,
        opacity_logits=np.full(count, np.log(opacity / (1 - opacity))),
        sh=0.3 * rng.normal(size=(count, 16, 3)),
        base_color=rng.random((count, 3)),
        roughness=rng.random(count),
        metallic=rng.random(count),
        object_id=np.zeros(count),
        kernel_degree=2,
        spacing=0.05,
    ).validate()


def room(count: int, sigma: float) -> GaussianScene:
    """The cube |x|, |y|, |z| < 1 seen from within: surfels on its walls at random, ``sigma`` wide."""
    rng = seeds.generator(0, "tests", "room", count)
    means = rng.uniform(-1, 1, (count, 3))
    wall, side = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    means[np.arange(count), wall] = side
    normals = np.zeros((count, 3))
    normals[np.arange(count), wall] = -side
    return scene_of(means, normals, np.full((count, 2), np.log(sigma)))


def cut_radii(scene: GaussianScene) -> np.ndarray:
    """Mahalanobis distance at which each surfel of degree 2 still counts."""
    return np.sqrt(-2 * np.log(np.maximum(MIN_RESPONSE, MIN_ALPHA / scene.opacities().astype(np.float64))))


def crossing(scene: GaussianScene, camera: Camera) -> np.ndarray:
    """(M,) bool, surfels on both sides of the plane through the camera's centre."""
    forward = camera.world_to_camera[2, :3].astype(np.float64)
    reach = cut_radii(scene) * np.linalg.norm(
        [scene.scales()[:, k] * (axis @ forward) for k, axis in enumerate(scene.tangents())], axis=0
    )
    return np.abs((scene.means - camera.position) @ forward) < reach


def seen(scene: GaussianScene, camera: Camera) -> np.ndarray:
    """(pixels, M) float64: t at which the pixel's ray clearly meets a surfel's front; infinite elsewhere."""
    directions = camera.rays().reshape(-1, 3).astype(np.float64)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    to_centre = scene.means.astype(np.float64) - camera.position
    normals = scene.normals().astype(np.float64)
    height = (to_centre * normals).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        facing = directions @ normals.T
        t = height / facing
        squared = np.zeros_like(t)
        for k, axis in enumerate(scene.tangents()):
            across = t * (directions @ axis.T) - (to_centre * axis).sum(1)
            squared += (across / scene.scales()[:, k]) ** 2
    clear = np.abs(height) > EDGE * np.linalg.norm(to_centre, axis=1)
    within = squared < (1 - EDGE) * cut_radii(scene) ** 2
    return np.where(clear & (height < 0) & (facing < 0) & (t > T_MIN) & within, t, np.inf)


def listed(tracer: SurfelTracer, camera: Camera) -> np.ndarray:
    """(pixels, M) float: the bound of t of surfels on the list of the pixel's tile; infinite elsewhere."""
    lists = build_tiles(tracer.records, camera)
    start, count, entries, near = (np.array(a) for a in (lists.start, lists.count, lists.entries, lists.near))
    on_list = np.full((len(start), tracer.records.count), np.inf)
    for tile in range(len(start)):
        part = slice(start[tile], start[tile] + count[tile])
        on_list[tile, entries[part]] = near[part]
        assert (np.diff(near[part]) >= 0).all()
    y, x = np.mgrid[: camera.height, : camera.width] // TILE
    return on_list[(y * tile_counts(camera.width, camera.height)[0] + x).ravel()]


tally: Counter[str] = Counter()


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**16),
    size=st.sampled_from((0.05, 0.3, 2.0, 30.0)),
    spread=st.sampled_from((0.02, 0.2, 1.0)),
    slender=st.sampled_from((1.0, 30.0)),
    focal=st.sampled_from((5.0, 20.0, 300.0)),
    shift=st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
)
def test_what_is_seen_of_surfels_across_the_camera_plane_is_listed_and_drawn(
    seed, size, spread, slender, focal, shift
):
    rng = seeds.generator(seed, "tests", "straddlers")
    count = 60
    look = Camera.look_at(rng.uniform(-1, 1, 3), rng.normal(size=3), fov_deg=60, width=24, height=20)
    camera = Camera(focal, 1.2 * focal, 12 + shift[0], 10 + shift[1], 24, 20, look.world_to_camera)
    scales = size * rng.uniform(0.2, 1, (count, 2)) * [1.0, 1 / slender]
    means = camera.position + spread * rng.normal(size=(count, 3))
    scene = scene_of(means, rng.normal(size=(count, 3)), np.log(scales), rng.uniform(0.1, 0.7, count))
    tracer = SurfelTracer(scene)
    t, near = seen(scene, camera), listed(tracer, camera)
    met = np.isfinite(t)
    assert not (met & ~np.isfinite(near)).any()
    assert (near[met] <= t[met]).all()
    tally.update(met=met.sum(), across=met[:, crossing(scene, camera)].sum())

    directions = camera.rays().reshape(-1, 3)
    truth = reference.composite(scene, np.tile(camera.position, (len(directions), 1)), directions)
    steady = (truth.margin > 1e-4) & (truth.gap > 1e-5 * max(1.0, size))
    picture = tracer.gbuffer(camera).numpy()
    np.testing.assert_allclose(picture["opacity"].ravel()[steady], 1 - truth.transmittance[steady], atol=2e-4)
    np.testing.assert_allclose(picture["rgb"].reshape(-1, 3)[steady], truth.rgb[steady], atol=1e-3)
    tally.update(rays=len(steady), steady=steady.sum())


def test_surfels_across_the_camera_plane_were_seen():
    if not tally:
        test_what_is_seen_of_surfels_across_the_camera_plane_is_listed_and_drawn()
    assert tally["across"] > 10_000
    assert tally["steady"] > 0.7 * tally["rays"]


def test_surfels_beside_the_camera_join_no_list():
    scene = room(3000, 0.04)
    camera = Camera.look_at((0.1, -0.2, 0.05), (1, 0.3, 0.1), fov_deg=70, width=64, height=64)
    across = crossing(scene, camera)
    on_list = np.isfinite(listed(SurfelTracer(scene), camera))
    assert across.sum() > 100
    assert not on_list[:, across].any()
    assert on_list.sum() < 4 * np.isfinite(seen(scene, camera)).sum()


def test_a_ground_that_goes_on_behind_the_camera_is_listed_below_its_horizon():
    scene = scene_of([[0.0, 0, 0]], [[0, 0, 1]], [[0.0, 0.0]], opacity=0.99)
    camera = Camera.look_at((0, 0, 0.5), (1, 0, 0.5), fov_deg=90, width=64, height=64)
    # The far edge of the disk lies at x = 3, half a unit below the eye: 32 * 0.5 / 3 pixels below the middle.
    rows = np.isfinite(listed(SurfelTracer(scene), camera)).reshape(64, 64).any(1)
    first = 4 * ((32 + round(32 * 0.5 / cut_radii(scene)[0])) // 4)
    np.testing.assert_array_equal(rows, np.arange(64) >= first)


def test_lists_are_in_the_order_in_which_a_tile_meets_large_slanted_surfels():
    rng = seeds.generator(0, "tests", "slanted")
    normals = rng.normal(size=(200, 3)) + np.array([0, 0, 3])
    scene = scene_of(rng.uniform(-0.5, 0.5, (200, 3)), normals, np.log(rng.uniform(0.1, 1, (200, 2))))
    camera = Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_deg=30, width=64, height=64)
    t, near = seen(scene, camera), listed(SurfelTracer(scene), camera)
    met = np.isfinite(t)
    # What is left is how much the depths differ at which the rays of a tile meet a surfel.
    assert np.median(t[met] - near[met]) < 0.05
    sphere = np.linalg.norm(scene.means - camera.position, axis=1) - (
        cut_radii(scene) * scene.scales().max(1)
    )
    assert np.median((t - sphere)[met]) > 0.5


def test_more_entries_than_indices_are_one_clear_line():
    count = 1 << 16
    one = np.array([0, 0, 0, 0.9, 1e-3, 0, 0, 3000, 0, 1e-3, 0, 9], np.float32)
    records = SurfelRecords(mi.Float(np.tile(one, count)), mi.Float(0), mi.Float(0), count, 2, 0)
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), up=(0, 1, 0), fov_deg=60, width=1024, height=1024)
    assert (
        dr.width(build_tiles(SurfelRecords(mi.Float(one), mi.Float(0), mi.Float(0), 1, 2, 0), camera).entries)
        == 1 << 16
    )
    # 2^16 surfels in 2^16 tiles each: 2^32 entries, which 32 bits count as none.
    with pytest.raises(TronError, match="4,294,967,296 tiles"):
        build_tiles(records, camera)
