"""Laws of stochastic first hits: in the mean they are compositing; by the seed they are always the same."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.gaussians.edit import moved
from tron.runtime import aligned
from tron.tracing import SurfelTracer, reference
from tron.tracing.hierarchy.first_hit import NOTHING, FirstHit, ray_seeds

pytestmark = pytest.mark.usefixtures("variant")

COPIES = 40_000


def seeds_of(count: int, seed: int = 0) -> mi.UInt32:
    lane = dr.arange(mi.UInt32, count)
    return ray_seeds(dr.opaque(mi.UInt32, 77 + seed), lane, dr.opaque(mi.UInt32, 3))


def along(values: np.ndarray) -> mi.Vector3f:
    """Vectors (N, 3), one a lane."""
    return mi.Vector3f(*[mi.Float(aligned(column)) for column in np.asarray(values, np.float32).T])


def at(values: np.ndarray) -> mi.Point3f:
    """Points (N, 3), one a lane."""
    return mi.Point3f(along(values))


def hits_of(tracer: SurfelTracer, origins: np.ndarray, directions: np.ndarray, seed: int = 0) -> FirstHit:
    found = tracer.first_hits(
        at(origins), [along(directions)], [mi.Bool(True)], [seeds_of(len(origins), seed)]
    )
    return found[0]


def columns(hit: FirstHit) -> np.ndarray:
    return np.stack([np.array(v, np.float64) for v in (hit.surfel, hit.front, hit.distance)])


@pytest.mark.parametrize("degree", [2, 4])
@pytest.mark.parametrize("two_sided", [True, False])
def test_a_surfel_is_met_with_the_weight_that_compositing_gives_it(
    random_scene, random_rays, degree: int, two_sided: bool
):
    scene = random_scene(150, degree=degree)
    tracer = SurfelTracer(scene).sided(two_sided)
    origins, directions = random_rays(12)
    expected = reference.first_hit_probabilities(scene, origins, directions, two_sided=two_sided)
    assert ((expected > 0.01).sum(1) >= 3).any()  # rays on which the order matters
    for origin, direction, probability in zip(origins, directions, expected):
        surfel = np.array(
            hits_of(tracer, np.tile(origin, (COPIES, 1)), np.tile(direction, (COPIES, 1))).surfel
        )
        met = np.bincount(surfel[surfel != NOTHING], minlength=len(scene)) / COPIES
        noise = np.sqrt(probability * (1 - probability) / COPIES)
        assert (np.abs(met - probability) <= 5 * noise + 1e-4).all()
        assert (met[probability == 0] == 0).all()
        assert abs((surfel == NOTHING).mean() - (1 - probability.sum())) < 0.02


def test_the_mean_of_what_is_met_is_what_compositing_sees(random_scene, random_rays):
    scene = random_scene(400)
    tracer = SurfelTracer(scene).sided(False)
    origins, directions = random_rays(64)
    copies = 2000
    hit = hits_of(tracer, np.repeat(origins, copies, 0), np.repeat(directions, copies, 0))
    surfel = np.array(hit.surfel).reshape(64, copies)
    there = surfel != NOTHING
    color = np.where(there[..., None], scene.base_color[np.where(there, surfel, 0)], 0)
    seen = tracer.trace(at(origins), along(directions))
    opacity = np.array(seen.opacity)
    assert (opacity > 0.5).sum() > 10
    np.testing.assert_allclose(there.mean(1), opacity, atol=5 * 0.5 / np.sqrt(copies))
    expected = np.array(seen.base_color).T * opacity[:, None]
    np.testing.assert_allclose(color.mean(1), expected, atol=5 * 0.5 / np.sqrt(copies))
    np.testing.assert_allclose(color.mean((0, 1)), expected.mean(0), atol=0.005)


def test_distance_and_side_are_those_of_the_surfel_met(random_scene, random_rays):
    scene = random_scene(300)
    origins, directions = random_rays(500)
    surfel, front, distance = columns(hits_of(SurfelTracer(scene), origins, directions))
    met = surfel != NOTHING
    assert 0.2 < met.mean() < 0.98
    assert np.isinf(distance[~met]).all()
    assert 0.2 < front[met].mean() < 0.98
    index = surfel[met].astype(int)
    point = origins[met] + distance[met, None] * directions[met]
    normal = scene.normals()[index]
    np.testing.assert_allclose(((point - scene.means[index]) * normal).sum(1), 0, atol=1e-4)
    np.testing.assert_array_equal(front[met] == 1, (normal * directions[met]).sum(1) < 0)


@pytest.mark.parametrize(("height", "stops"), [(0.15, False), (0.25, True)])
def test_back_faces_stop_rays_beyond_two_spacings(disks, height: float, stops: bool):
    """As they block shadow rays; fronts stop rays from wherever they start, and one-sided backs none."""
    ray = np.array([[0.0, 0, 0]]), np.array([[0.0, 0, 1]])
    for down in (False, True):
        scene = disks([[0, 0, height]], [down], opacity=0.999, sigma=0.05)
        scene.spacing = 0.1
        tracer = SurfelTracer(scene)
        rays = [np.repeat(values, 1000, 0) for values in ray]
        share = (np.array(hits_of(tracer, *rays).surfel) == 0).mean()
        assert share == pytest.approx(0.99 * (stops or down), abs=0.02)
        alone = (np.array(hits_of(tracer.sided(False), *rays).surfel) == 0).mean()
        assert alone == pytest.approx(0.99 * down, abs=0.02)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_hit(random_scene, random_rays):
    tracer = SurfelTracer(random_scene(300))
    rays = random_rays(2000)
    first = columns(hits_of(tracer, *rays))
    np.testing.assert_array_equal(columns(hits_of(tracer, *rays)), first)
    other = columns(hits_of(tracer, *rays, seed=1))
    assert 0.1 < (other[0] != first[0]).mean() < 0.9


def test_neither_the_hierarchys_order_nor_the_form_of_a_fan_decides(random_scene, random_rays):
    scene = random_scene(600)
    rng_turned = moved(scene, np.arange(300), translation=np.array([0.4, -0.3, 0.2]))
    origins, directions = random_rays(1200)
    kept, anew = SurfelTracer(scene).moved(rng_turned), SurfelTracer(rng_turned)
    assert (np.array(kept.bvh.order) != np.array(anew.bvh.order)).any()
    alone = columns(hits_of(anew, origins, directions))
    np.testing.assert_array_equal(columns(hits_of(kept, origins, directions)), alone)
    # Four rays of one lane, as a fan and each by itself.
    origin, seeds = at(origins[:300]), [seeds_of(300, k) for k in range(4)]
    fan = [along(directions[k * 300 : (k + 1) * 300]) for k in range(4)]
    together = anew.first_hits(origin, fan, [mi.Bool(True)] * 4, seeds)
    for hit, direction, seed in zip(together, fan, seeds):
        (single,) = anew.first_hits(origin, [direction], [mi.Bool(True)], [seed])
        np.testing.assert_array_equal(columns(hit), columns(single))


@dr.syntax
def in_a_loop(tracer: SurfelTracer, origin: mi.Point3f, direction: mi.Vector3f, seed: mi.UInt32):
    """What a recorded loop finds in its last turn."""
    k, surfel, distance = mi.UInt32(0), mi.UInt32(0), mi.Float(0)
    while k < 2:
        (hit,) = tracer.first_hits(origin, [direction], [mi.Bool(True)], [seed])
        surfel, distance = hit.surfel, hit.distance
        k += 1
    return surfel, distance


def test_within_a_recorded_loop_the_same_is_met(random_scene, random_rays):
    tracer = SurfelTracer(random_scene(200))
    origins, directions = random_rays(500)
    surfel, _, distance = columns(hits_of(tracer, origins, directions))
    found = in_a_loop(tracer, at(origins), along(directions), seeds_of(500))
    np.testing.assert_array_equal(np.array(found[0]), surfel)
    np.testing.assert_array_equal(np.array(found[1]), distance)


def test_inactive_rays_meet_nothing(random_scene, random_rays):
    tracer = SurfelTracer(random_scene(300))
    origins, directions = random_rays(400)
    lanes = dr.arange(mi.UInt32, 400) % 3 == 0
    (some,) = tracer.first_hits(at(origins), [along(directions)], [lanes], [seeds_of(400)])
    every = columns(hits_of(tracer, origins, directions))
    active = np.array(lanes)
    np.testing.assert_array_equal(columns(some)[:, active], every[:, active])
    assert (np.array(some.surfel)[~active] == NOTHING).all()


def test_no_surfel_stops_nothing(random_scene, random_rays):
    scene = random_scene(3)
    none = replace(scene, opacity_logits=np.full(3, -20.0))
    hit = hits_of(SurfelTracer(none), *random_rays(100))
    assert (np.array(hit.surfel) == NOTHING).all()
    assert np.isinf(np.array(hit.distance)).all()


def test_other_sizes_and_seeds_compile_no_new_kernel(random_scene, random_rays, kernels_of):
    tracers = {surfels: SurfelTracer(random_scene(surfels)) for surfels in (300, 400)}

    def trace(count: int, surfels: int, seed: int) -> None:
        dr.eval(hits_of(tracers[surfels], *random_rays(count), seed=seed))

    dr.eval([tracer.bvh for tracer in tracers.values()])
    trace(1000, 300, 0)
    first = kernels_of(lambda: trace(1000, 300, 0))
    assert kernels_of(lambda: trace(1700, 400, 9)) <= first, "compiled anew"
