"""Shadow rays over random scenes against the reference, closed forms at an angle, and degenerate scenes."""

from __future__ import annotations

import dataclasses
from collections import Counter

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tron.tracing import SurfelTracer, reference

pytestmark = pytest.mark.usefixtures("variant")

THRESHOLD = 1e-6
"""A tenth of what would be allowed: so near to a threshold, float32 may decide otherwise."""


tally: Counter[str] = Counter()


@settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    seed=st.integers(0, 2**16),
    count=st.integers(1, 300),
    degree=st.sampled_from((2, 4)),
    size=st.floats(0.3, 3.0),
    spacing=st.floats(0.0, 0.5),
    two_sided=st.booleans(),
)
def test_random_scenes_agree_with_the_float64_reference(
    random_rays, shadows, random_scene, seed, count, degree, size, spacing, two_sided
):
    scene = random_scene(count, degree=degree, sh_degree=0, seed=seed)
    scene.log_scales += np.float32(np.log(size))
    scene.spacing = 1e-3 + spacing
    origins, directions = random_rays(2000, seed)
    truth, margin = reference.transmittance(scene, origins, directions, two_sided=two_sided)
    steady = margin > THRESHOLD
    tally.update(rays=len(truth), left_out=(~steady).sum(), dimmed=(truth < 1).sum(), dark=(truth == 0).sum())
    found = shadows(SurfelTracer(scene).sided(two_sided), origins, directions)
    np.testing.assert_allclose(found[steady], truth[steady], atol=1e-4)


def test_few_rays_were_left_out_and_many_were_blocked(random_scene):
    if not tally:
        test_random_scenes_agree_with_the_float64_reference(random_scene)
    assert tally["rays"] > 20_000
    assert tally["left_out"] < 1e-3 * tally["rays"]
    assert tally["dimmed"] > 0.2 * tally["rays"]
    assert tally["dark"] > 0.02 * tally["rays"]


@pytest.mark.parametrize("degree", [2, 4])
@pytest.mark.parametrize("tilt", [0.0, 50.0, 80.0])
def test_one_surfel_has_its_closed_form(shadows, disks, degree, tilt):
    """1 - o exp(-r^2 / 2 s^2), or with r^4 / 18 s^4; r where it meets the tilted plane. 1 past the cut."""
    sigma, opacity = 0.1, 0.7
    scene = disks([[0, 0, 0]], [False], opacity=opacity, sigma=sigma, degree=degree)
    half = np.radians(tilt) / 2
    scene.quats[:] = [[np.cos(half), 0, np.sin(half), 0]]  # about y: x runs along the slope
    x = np.linspace(-0.5, 0.5, 401)
    origins = np.stack([x, np.zeros(401), np.full(401, 5.0)], 1)
    q = (x / np.cos(np.radians(tilt)) / sigma) ** 2
    response = np.exp(-q / 2) if degree == 2 else np.exp(-q * q / 18)
    alpha = np.where((response >= 0.0113) & (opacity * response >= 1 / 255), opacity * response, 0)
    found = shadows(SurfelTracer(scene), origins, np.tile([0, 0, -1], (401, 1)))
    clear = np.abs(response - 0.0113) > 1e-4
    np.testing.assert_allclose(found[clear], 1 - alpha[clear], atol=2e-5)
    assert (found < 0.5).any()
    assert (found == 1).any()


def test_stacked_surfels_multiply_whatever_their_distance(shadows, disks):
    heights = [0.01, 1.0, 3.0, 1e3]
    scene = disks([[0, 0, h] for h in heights], [True] * 4, opacity=0.5, sigma=0.4)
    for below in range(5):
        start = 0.5 * ([0, *heights][below] + heights[below]) if below < 4 else 2e3
        assert shadows(SurfelTracer(scene), [[0, 0, start]], [[0, 0, 1]])[0] == pytest.approx(
            0.5 ** (4 - below)
        )


def test_an_empty_scene_is_clear(random_rays, shadows, disks):
    scene = disks([[0, 0, 0]], [False], opacity=0.9, sigma=0.2)
    arrays = {
        f.name: getattr(scene, f.name)[:0]
        for f in dataclasses.fields(scene)
        if isinstance(getattr(scene, f.name), np.ndarray) and f.name != "up"
    }
    empty = dataclasses.replace(scene, **arrays)
    assert (shadows(SurfelTracer(empty), *random_rays(100)) == 1).all()


def test_coincident_surfels_all_count(shadows, disks):
    faint = disks([[0.1, 0.2, 0.3]] * 500, [True] * 500, opacity=0.005, sigma=0.3)
    found = shadows(SurfelTracer(faint), [[0.1, 0.2, 0.0]], [[0, 0, 1]])
    np.testing.assert_allclose(found, 0.995**500, rtol=1e-3)


@pytest.mark.parametrize("sigma", [1e-6, 1e-3, 1e3, 1e6])
def test_huge_and_tiny_surfels_block_what_they_cover(shadows, disks, sigma):
    scene = disks([[0, 0, 1]], [True], opacity=0.8, sigma=sigma)
    origins = np.array([[0, 0, 0], [0.5 * sigma, 0, 0], [10 * sigma, 0, 0]])
    found = shadows(SurfelTracer(scene), origins, [[0, 0, 1]] * 3)
    np.testing.assert_allclose(found, [0.2, 1 - 0.8 * np.exp(-0.125), 1], rtol=1e-3)


def test_a_huge_surfel_hides_no_small_one(random_rays, shadows, random_scene, disks):
    """Bounds of every size in one hierarchy, against the reference."""
    scene = random_scene(200)
    scene.log_scales[::10] = np.log(100.0)
    scene.log_scales[1::10] = np.log(1e-4)
    scene.opacity_logits[::10] = -3.0
    origins, directions = random_rays(2000)
    truth, margin = reference.transmittance(scene, origins, directions)
    steady = margin > 1e-5
    assert steady.mean() > 0.9
    np.testing.assert_allclose(
        shadows(SurfelTracer(scene), origins, directions)[steady], truth[steady], atol=1e-4
    )


def test_edge_on_surfels_block_nothing_and_stay_finite(shadows, disks):
    scene = disks([[0, 0, 0]], [False], opacity=0.9, sigma=0.2)
    origins = [[-1, 0, 0], [-1, 0.1, 0], [-1, 0, 1e-8]]
    assert (shadows(SurfelTracer(scene), origins, [[1, 0, 0]] * 3) == 1).all()


def test_far_from_the_origin_of_the_world_the_same_is_seen(random_rays, shadows, random_scene):
    """Translation: what float32 can still hold a thousand units away."""
    scene, moved = random_scene(200), random_scene(200)
    origins, directions = random_rays(1000)
    step = np.array([1024.0, -512.0, 256.0], np.float32)
    moved.means += step
    scene.means[:] = moved.means - step  # rounded alike
    origins = (origins + step) - step
    here, there = (
        shadows(SurfelTracer(scene), origins, directions),
        shadows(SurfelTracer(moved), origins + step, directions),
    )
    assert np.abs(here - there).mean() < 1e-4
    assert (np.abs(here - there) > 0.02).mean() < 2e-3
