"""Laws of per-surfel values: composited as materials are, at their price only where they are asked for."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.errors import TronError
from tron.tracing import SurfelTracer
from tron.tracing.parameters import SurfelParameters

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = Camera.look_at((2.0, 0.7, 0.5), (0, 0, 0), fov_deg=50, width=21, height=14)


def materials(scene) -> list[mi.Float]:
    """Base color, roughness and metallic of each surfel."""
    columns = [*scene.base_color.T, scene.roughness, scene.metallic]
    return [mi.Float(np.ascontiguousarray(column)) for column in columns]


@pytest.mark.parametrize("surfels", [300, 4000])  # of 4000, some rays meet more than streaming holds
def test_a_material_given_as_values_comes_back_as_the_material(random_scene, surfels: int):
    scene = random_scene(surfels)
    seen = SurfelTracer(scene).gbuffer(CAMERA, materials(scene)).numpy()
    assert seen["values"].shape == (14, 21, 5)
    np.testing.assert_allclose(seen["values"][..., :3], seen["base_color"], atol=1e-6)
    np.testing.assert_allclose(seen["values"][..., 3], seen["roughness"], atol=1e-6)
    np.testing.assert_allclose(seen["values"][..., 4], seen["metallic"], atol=1e-6)
    assert (seen["opacity"] > 0.5).mean() > 0.3


def test_each_number_of_values_is_recorded_by_itself(random_scene):
    """Three of a scene of degrees 4 and 3, then four: Dr.Jit took one for the other."""
    scene = random_scene(60)
    scene = replace(scene, kernel_degree=4, sh=np.tile(scene.sh[:, :1], (1, 16, 1)))
    tracer = SurfelTracer(scene)
    for count in (3, 4, 3, 2, 5):
        assert len(tracer.gbuffer(CAMERA, materials(scene)[:count]).values) == count


def test_any_rays_see_the_values_that_camera_rays_see(random_scene):
    scene = random_scene(300)
    tracer = SurfelTracer(scene)
    pixels = CAMERA.rays().reshape(-1, 3).T
    direction = mi.Vector3f(np.ascontiguousarray(pixels, dtype=np.float32))
    origin = mi.Point3f(*map(float, CAMERA.position))
    seen = tracer.trace(origin, direction, values=materials(scene))
    expected = tracer.gbuffer(CAMERA, materials(scene)).rows()
    np.testing.assert_allclose(np.array(seen.values), np.array(expected.values), atol=1e-5)


@pytest.mark.parametrize("count", [1, 4, 5])
def test_values_change_nothing_else(random_scene, count: int):
    scene = random_scene(300)
    tracer = SurfelTracer(scene)
    plain = tracer.gbuffer(CAMERA)
    assert plain.values == []
    assert "values" not in plain.numpy()
    seen = tracer.gbuffer(CAMERA, materials(scene)[:count]).numpy()
    for name, image in plain.numpy().items():
        np.testing.assert_array_equal(seen[name], image, err_msg=name)


def test_values_of_the_wrong_length_are_refused(random_scene):
    with pytest.raises(TronError, match=r"values\[1\] has 7 numbers"):
        SurfelTracer(random_scene(9)).gbuffer(CAMERA, [mi.Float(1), dr.zeros(mi.Float, 7)])


def loss_of(values: list[mi.Float]) -> mi.Float:
    """A random linear functional of composited values, which are linear in the surfels'."""
    total = mi.Float(0)
    for k, value in enumerate(values):
        weight = seeds.generator(0, "tests", "loss", k).normal(size=dr.width(value))
        total += dr.sum(mi.Float(weight.astype(np.float32)) * value)
    return total


@pytest.mark.parametrize("surfels", [60, 4000])
@pytest.mark.parametrize("arbitrary", [False, True])
def test_gradients_of_values_are_differences(random_scene, surfels: int, arbitrary: bool):
    tracer, count = SurfelTracer(random_scene(surfels)), 5
    rng = seeds.generator(0, "tests", "values", surfels)
    given = rng.normal(size=(count, surfels)).astype(np.float32)

    def seen(values: list[mi.Float]) -> list[mi.Float]:
        if not arbitrary:
            return tracer.gbuffer(CAMERA, values).values
        direction = mi.Vector3f(np.ascontiguousarray(CAMERA.rays().reshape(-1, 3).T, dtype=np.float32))
        return tracer.trace(mi.Point3f(*map(float, CAMERA.position)), direction, values=values).values

    values = [mi.Float(row) for row in given]
    dr.enable_grad(values)
    dr.backward(loss_of(seen(values)))
    found = np.array([dr.grad(value) for value in values])
    step = rng.normal(size=(count, surfels)).astype(np.float32)
    ends = [loss_of(seen([mi.Float(row) for row in given + sign * step]))[0] for sign in (1, -1)]
    assert (found * step).sum() == pytest.approx((ends[0] - ends[1]) / 2, rel=1e-3)
    assert (found != 0).mean() > 0.1


def test_gradients_reach_surfels_through_values_as_through_their_materials(random_scene):
    scene = random_scene(200)
    gradients = []
    for by_values in (False, True):
        parameters = SurfelParameters.from_scene(scene)
        dr.enable_grad(parameters.means, parameters.opacity_logits)
        tracer = SurfelTracer(scene, parameters=parameters)
        seen = tracer.gbuffer(CAMERA, materials(scene)[:3] if by_values else ())
        dr.backward(loss_of(seen.values if by_values else list(seen.base_color)))
        gradients.append([np.array(dr.grad(v)) for v in (parameters.means, parameters.opacity_logits)])
    for by_material, by_value in zip(*gradients):
        assert np.abs(by_material).max() > 0
        np.testing.assert_allclose(by_value, by_material, atol=1e-4 * np.abs(by_material).max())
