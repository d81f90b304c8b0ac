"""Rays that meet more surfels than a hit list holds, and rays of any kind through the hierarchy."""

from __future__ import annotations

import dataclasses

import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.errors import TronError
from tron.tracing import SurfelTracer, reference
from tron.tracing.hits import MAX_HITS

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def camera():
    return Camera.look_at((0.02, 0.01, 1), (0, 0, 0), up=(0, 1, 0), fov_deg=30, width=9, height=7)


def single(values):
    return np.asarray(values, np.float32)


def rays(camera):
    directions = camera.rays().reshape(-1, 3)
    return np.tile(camera.position, (len(directions), 1)), directions


def mitsuba_rays(origins, directions):
    return mi.Point3f(single(origins).T.copy()), mi.Vector3f(single(directions).T.copy())


def assert_agrees(seen, truth):
    opacity = 1 - truth.transmittance
    steady = truth.margin > 1e-6
    assert steady.mean() > 0.9
    np.testing.assert_allclose(np.array(seen.opacity)[steady], opacity[steady], atol=1e-5)
    np.testing.assert_allclose(np.array(seen.depth)[steady], truth.median_depth[steady], atol=1e-5)
    color = np.array(seen.base_color).T * opacity[:, None]
    np.testing.assert_allclose(color[steady], truth.base_color[steady], atol=1e-5)


@pytest.mark.parametrize("degree", [2, 4])
def test_500_coincident_surfels_are_composited_in_the_order_of_their_ids(disks, camera, degree):
    scene = disks([[0, 0, 0]] * 500, [False] * 500, opacity=0.01, sigma=0.5, degree=degree)
    # Colours without order: composited in another order, the sum is another one.
    rng = seeds.generator(0, "tests", "coincident")
    scene.base_color = single(rng.random((500, 3)))
    truth = reference.composite(scene, *rays(camera))
    assert truth.hits.min() > 400
    tracer = SurfelTracer(scene)
    assert_agrees(tracer.gbuffer(camera), truth)
    assert_agrees(tracer.trace(*mitsuba_rays(*rays(camera))), truth)
    shuffled = dataclasses.replace(scene, base_color=scene.base_color[rng.permutation(500)])
    other = reference.composite(shuffled, *rays(camera)).base_color
    assert np.abs(other - truth.base_color).max() > 1e-2


def test_more_hits_than_a_list_holds_at_different_depths(disks, camera):
    count = 3 * MAX_HITS
    rng = seeds.generator(0, "tests", "stack")
    heights = rng.permutation(np.linspace(-0.5, 0.5, count))  # ids say nothing about depth
    scene = disks([[0, 0, z] for z in heights], [False] * count, opacity=0.03, sigma=0.4)
    truth = reference.composite(scene, *rays(camera))
    assert truth.hits.max() > 2 * MAX_HITS
    assert_agrees(SurfelTracer(scene).gbuffer(camera), truth)


def test_crowded_and_ordinary_pixels_share_an_image(disks, camera):
    means = [[0.1, 0, 0.001 * k] for k in range(100)] + [[-0.1, 0, 0.01 * k] for k in range(5)]
    scene = disks(means, [False] * 105, opacity=0.05, sigma=0.03)
    truth = reference.composite(scene, *rays(camera))
    assert truth.hits.max() > MAX_HITS
    assert 0 < truth.hits[truth.hits > 0].min() < MAX_HITS
    assert (truth.hits == 0).any()
    assert_agrees(SurfelTracer(scene).gbuffer(camera), truth)


@pytest.mark.parametrize("degree", [2, 4])
def test_rays_in_all_directions_agree_with_the_reference(random_scene, degree):
    scene = random_scene(150, degree=degree)
    rng = seeds.generator(0, "tests", "all directions")
    directions = rng.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = rng.uniform(-1.5, 1.5, (500, 3))
    truth = reference.composite(scene, single(origins), single(directions))
    assert_agrees(SurfelTracer(scene).trace(*mitsuba_rays(origins, directions)), truth)


def test_inactive_rays_see_nothing(disks):
    tracer = SurfelTracer(disks([[0, 0, 0]], [False], opacity=0.9, sigma=0.3))
    origin, direction = mitsuba_rays([[0, 0, 1], [0, 0, 1]], [[0, 0, -1], [0, 0, -1]])
    seen = tracer.trace(origin, direction, mi.Bool([True, False]))
    np.testing.assert_allclose(np.array(seen.opacity), [0.9, 0], atol=1e-6)


def test_a_scene_without_surfels_is_empty(disks, camera):
    full = disks([[0, 0, 0]], [False], opacity=0.9, sigma=0.3)
    arrays = {f.name: getattr(full, f.name) for f in dataclasses.fields(full)}
    arrays = {name: v[:0] if isinstance(v, np.ndarray) and name != "up" else v for name, v in arrays.items()}
    scene = type(full)(**arrays)
    with pytest.raises(TronError, match="no surfels"):
        scene.validate()
    tracer = SurfelTracer(scene)
    for values in tracer.gbuffer(camera).numpy().values():
        assert np.isfinite(values).all()
    assert tracer.gbuffer(camera).numpy()["opacity"].max() == 0
    origin, direction = mitsuba_rays(*rays(camera))
    assert np.array(tracer.trace(origin, direction).opacity).max() == 0
    assert np.array(tracer.transmittance(origin, direction)).min() == 1


@pytest.mark.parametrize("field", ["means", "quats", "log_scales", "opacity_logits", "sh", "base_color"])
def test_what_is_not_a_number_is_refused_at_the_door(random_scene, field):
    scene = random_scene(5)
    getattr(scene, field).reshape(5, -1)[3, 0] = np.nan
    with pytest.raises(TronError, match=f"{field} of 1 of 5 surfels is not finite"):
        scene.validate()
