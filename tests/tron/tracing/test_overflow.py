"""Rays that meet more surfels than fit at a time, and rays of any kind through the hierarchy."""

from __future__ import annotations

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.fields import PARAMETERS
from tron.gaussians.scene import GaussianScene
from tron.tracing import SurfelTracer, adjoint, gbuffer, reference
from tron.tracing.compositing import HitList
from tron.tracing.gbuffer import stream
from tron.tracing.hits import MAX_HITS
from tron.tracing.parameters import SurfelParameters
from tron.tracing.tiled import kbuffer

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def camera():
    return Camera.look_at((0.02, 0.01, 1), (0, 0, 0), up=(0, 1, 0), fov_deg=30, width=9, height=7)


def single(values):
    return np.asarray(values, np.float32)


@pytest.fixture
def close_up():
    """Sees nothing but :func:`stack`."""
    return Camera.look_at((0.001, 0.002, 1), (0, 0, 0), up=(0, 1, 0), fov_deg=1.5, width=9, height=7)


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
    np.testing.assert_allclose(np.array(seen.lift)[steady], truth.lift[steady], atol=1e-5)
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
    assert_agrees(tracer.gbuffer(camera).rows(), truth)
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
    assert_agrees(SurfelTracer(scene).gbuffer(camera).rows(), truth)


@pytest.fixture
def once(monkeypatch):
    """Fails where rays have to be traced a second time."""

    def second_time(*args):
        raise AssertionError("these rays have room enough")

    monkeypatch.setattr(gbuffer, "composite_rounds", second_time)


def stack(disks, levels, alike, opacity):
    """Levels of small disks, ``alike`` coincident ones on each; ids say nothing about depth."""
    heights = np.repeat(np.linspace(-1, 0.5, levels), alike)
    rng = seeds.generator(0, "tests", "small", levels, alike)
    means = np.stack([np.zeros(len(heights)), np.zeros(len(heights)), rng.permutation(heights)], 1)
    scene = disks(means, [False] * len(heights), opacity=opacity, sigma=0.02)
    scene.base_color = single(rng.random((len(heights), 3)))
    return scene


@pytest.mark.parametrize("alike", [1, 3, 7])
def test_many_hits_of_small_surfels_are_composited_as_they_come(disks, close_up, once, alike):
    scene = stack(disks, 420 // alike, alike, 0.02)
    truth = reference.composite(scene, *rays(close_up))
    assert truth.hits.min() > 4 * MAX_HITS
    assert_agrees(SurfelTracer(scene).gbuffer(close_up).rows(), truth)


def crowd(seed, count=700):
    """Large, faint surfels about the origin that face the camera, as reconstructions begin."""
    rng = seeds.generator(seed, "tests", "crowd", count)
    quats = rng.normal(size=(count, 4)) * [1, 0.3, 0.3, 1]
    return GaussianScene(
        means=rng.uniform([-0.3, -0.3, -0.6], [0.3, 0.3, 0.4], (count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        log_scales=np.log(rng.uniform(0.02, 0.12, (count, 2))),
        opacity_logits=rng.normal(-2, 0.7, count),
        sh=0.3 * rng.normal(size=(count, 16, 3)),
        base_color=rng.random((count, 3)),
        roughness=rng.random(count),
        metallic=rng.random(count),
        object_id=np.zeros(count),
        kernel_degree=2,
        spacing=0.05,
    ).validate()


@pytest.mark.parametrize("seed", [0, 1])
def test_crowds_agree_with_the_reference_without_a_second_pass(camera, once, seed):
    scene = crowd(seed)
    truth = reference.composite(scene, *rays(camera))
    assert np.median(truth.hits) > MAX_HITS
    assert_agrees(SurfelTracer(scene).gbuffer(camera).rows(), truth)


def gradients(scene, trace):
    """Of a fixed sum over what ``trace(tracer)`` sees, by every parameter."""
    parameters = SurfelParameters.from_scene(scene)
    for name in PARAMETERS:
        dr.enable_grad(getattr(parameters, name))
    seen = trace(SurfelTracer(scene, parameters=parameters))
    ray = dr.arange(mi.Float, dr.width(seen.opacity))
    channels = [*seen.rgb, *seen.base_color, *seen.normal, seen.roughness, seen.metallic, seen.opacity]
    total = mi.Float(0)
    for k, value in enumerate(channels):
        total += dr.sin(1 + ray + 3 * k) * value
    dr.backward(dr.sum(total))
    return {name: np.array(dr.grad(getattr(parameters, name))) for name in PARAMETERS}


@pytest.mark.parametrize("kind", ["crowd", "more than are kept", "all wait"])
def test_gradients_of_crowds_are_those_of_rays_through_the_hierarchy(disks, camera, close_up, kind):
    if kind == "crowd":
        scene = crowd(2, 480)
    elif kind == "more than are kept":
        scene, camera = stack(disks, 300, 1, 0.01), close_up
    else:
        scene = disks([[0, 0, 0]] * 120, [False] * 120, opacity=0.02, sigma=0.4)
    hits = reference.composite(scene, *rays(camera)).hits
    assert np.median(hits) > MAX_HITS
    assert (hits > gbuffer.KEPT_HITS).any() == (kind == "more than are kept")
    by_tiles = gradients(scene, lambda tracer: tracer.gbuffer(camera).rows())
    by_rounds = gradients(scene, lambda tracer: tracer.trace(*mitsuba_rays(*rays(camera))))
    for name, expected in by_rounds.items():
        np.testing.assert_allclose(by_tiles[name], expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("way", ["tiles", "hierarchy"])
def test_gradients_of_crowds_need_no_more_memory_than_they_are_given(disks, camera, monkeypatch, way):
    scene = disks([[0, 0, 0]] * 120, [False] * 120, opacity=0.02, sigma=0.4)

    def trace(tracer):
        return tracer.gbuffer(camera).rows() if way == "tiles" else tracer.trace(*mitsuba_rays(*rays(camera)))

    expected = gradients(scene, trace)
    most, reserved = 20 * 120, []
    for module in (gbuffer, kbuffer):
        monkeypatch.setattr(module, "LISTED_IDS", most)

    class Watched(HitList):
        @staticmethod
        def empty(ray, room):
            reserved.append(room * dr.width(ray))
            return HitList.empty(ray, room)

    monkeypatch.setattr(kbuffer, "HitList", Watched)
    found = gradients(scene, trace)
    assert len(reserved) >= 4  # 63 pixels, at most 20 of which have room at a time
    assert max(reserved) <= most
    for name in PARAMETERS:
        np.testing.assert_allclose(
            found[name], expected[name], rtol=1e-3, atol=1e-4 * np.abs(found[name]).max()
        )


def test_gradients_are_the_same_where_threads_have_no_copies_to_add_to(camera, monkeypatch):
    scene = crowd(3, 200)
    expected = gradients(scene, lambda tracer: tracer.gbuffer(camera).rows())
    monkeypatch.setattr(adjoint, "COPIED_BYTES", 0)
    for name, found in gradients(scene, lambda tracer: tracer.gbuffer(camera).rows()).items():
        np.testing.assert_allclose(found, expected[name], rtol=1e-3, atol=1e-5 * np.abs(found).max())


def test_what_is_recorded_serves_scenes_and_images_of_any_size(random_scene):
    def see(count, width, height, differentiable):
        view = Camera.look_at((2.5, 1, 0.7), (0, 0, 0), fov_deg=50, width=width, height=height)
        # Harmonics would be read where NumPy has them, and memory that is not aligned is recorded once more.
        scene = random_scene(count, sh_degree=0)
        parameters = SurfelParameters.from_scene(scene)
        dr.set_grad_enabled(parameters.means, differentiable)
        tracer = SurfelTracer(scene, parameters=parameters)
        assert_agrees(tracer.gbuffer(view).rows(), reference.composite(scene, *rays(view)))

    see(100, 17, 9, False)
    see(100, 17, 9, True)
    before = stream.__wrapped__.n_recordings
    for count, width, height in ((150, 30, 22), (100, 8, 31), (151, 17, 9)):
        see(count, width, height, False)
        see(count, 17, 9, True)  # memory for hits is of one size for one image
    assert stream.__wrapped__.n_recordings == before


def test_crowded_and_ordinary_pixels_share_an_image(disks, camera):
    means = [[0.1, 0, 0.001 * k] for k in range(100)] + [[-0.1, 0, 0.01 * k] for k in range(5)]
    scene = disks(means, [False] * 105, opacity=0.05, sigma=0.03)
    truth = reference.composite(scene, *rays(camera))
    assert truth.hits.max() > MAX_HITS
    assert 0 < truth.hits[truth.hits > 0].min() < MAX_HITS
    assert (truth.hits == 0).any()
    assert_agrees(SurfelTracer(scene).gbuffer(camera).rows(), truth)


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
