"""Laws of the gradient of shadows by opacity: float64 differences, and zeros where zeros are due."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.fields import PARAMETERS
from tron.shading.environment import EnvironmentLight, EnvironmentMap
from tron.shading.transport import Transport
from tron.tracing import SurfelTracer, reference
from tron.tracing.parameters import SurfelParameters

pytestmark = pytest.mark.usefixtures("variant")

STEP = 1e-6


def tracer_and_parameters(scene, *, two_sided: bool = True) -> tuple[SurfelTracer, SurfelParameters]:
    parameters = SurfelParameters.from_scene(scene)
    for name in PARAMETERS:
        dr.enable_grad(getattr(parameters, name))
    return SurfelTracer(scene, parameters=parameters).sided(two_sided), parameters


def rays(origins, directions) -> tuple[mi.Point3f, mi.Vector3f]:
    columns = [np.ascontiguousarray(np.asarray(a, np.float32).T) for a in (origins, directions)]
    return mi.Point3f(columns[0]), mi.Vector3f(columns[1])


@pytest.mark.parametrize("degree", [2, 4])
@pytest.mark.parametrize("two_sided", [True, False])
def test_gradient_by_opacity_agrees_with_float64_differences(random_scene, degree, two_sided):
    scene = random_scene(150, degree=degree)
    scene.opacity_logits += 2  # so that some rays are blocked
    rng = seeds.generator(0, "tests", "shadow gradient")
    origins, directions = rng.uniform(-1.5, 1.5, (400, 3)), rng.normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins, directions = np.float32(origins), np.float32(directions)
    truth, margin = reference.transmittance(scene, origins, directions, two_sided=two_sided)
    weights = rng.normal(size=400) * (margin > 1e-4)
    tracer, parameters = tracer_and_parameters(scene, two_sided=two_sided)
    origin, direction = rays(origins, directions)
    found = tracer.transmittance_by_opacity(origin, direction)
    np.testing.assert_array_equal(np.array(found), np.array(tracer.transmittance(origin, direction)))
    dr.backward(dr.sum(mi.Float(weights.astype(np.float32)) * found))
    gradient = np.array(dr.grad(parameters.opacity_logits))

    double = {name: getattr(scene, name).astype(np.float64) for name in PARAMETERS}
    entries, expected = rng.choice(len(scene), 40, replace=False), []
    for entry in entries:
        ends = []
        for sign in (1, -1):
            logits = double["opacity_logits"].copy()
            logits[entry] += sign * STEP
            moved = SimpleNamespace(
                **{**double, "opacity_logits": logits}, kernel_degree=degree, spacing=scene.spacing
            )
            values, _ = reference.transmittance(moved, origins, directions, two_sided=two_sided)
            ends.append((weights * values).sum())
        expected.append((ends[0] - ends[1]) / (2 * STEP))
    assert np.abs(expected).max() > 0.1
    assert 0 < (truth == 0).sum() < 400
    np.testing.assert_allclose(gradient[entries], expected, atol=1e-4 * np.abs(expected).max())
    for name in PARAMETERS:
        if name != "opacity_logits":
            assert np.abs(np.array(dr.grad(getattr(parameters, name)))).max() == 0


@pytest.mark.parametrize(("layers", "opacity"), [(6, 0.8), (1, 0.9999)])
def test_blocked_rays_and_clipped_surfels_have_no_gradient(disks, layers, opacity):
    scene = disks([[0, 0, 0.3 + 0.1 * k] for k in range(layers)], [True] * layers, opacity=opacity, sigma=0.5)
    tracer, parameters = tracer_and_parameters(scene)
    dr.backward(tracer.transmittance_by_opacity(*rays([[0, 0, 0]], [[0, 0, 1]])))
    assert np.abs(np.array(dr.grad(parameters.opacity_logits))).max() == 0


def test_by_default_shadows_have_no_gradient(disks):
    tracer, _ = tracer_and_parameters(disks([[0, 0, 0.5]], [True], opacity=0.5, sigma=0.3))
    assert not dr.grad_enabled(tracer.transmittance(*rays([[0, 0, 0]], [[0, 0, 1]])))
    assert dr.grad_enabled(tracer.transmittance_by_opacity(*rays([[0, 0, 0]], [[0, 0, 1]])))


def test_gradients_come_as_often_as_they_are_asked_for(random_scene):
    tracer, parameters = tracer_and_parameters(random_scene(60))
    camera = Camera.look_at((2.5, 1, 0.7), (0, 0, 0), fov_deg=50, width=12, height=8)
    gradients = []
    for _ in range(3):
        dr.backward(dr.sum(tracer.gbuffer(camera).opacity))
        gradients.append(np.array(dr.grad(parameters.opacity_logits)))
        dr.clear_grad(parameters.opacity_logits)
    assert np.abs(gradients[0]).max() > 0
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-5)
    np.testing.assert_allclose(gradients[2], gradients[0], rtol=1e-5)


def test_a_tracer_follows_its_parameters(random_scene):
    scene = random_scene(60)
    parameters = SurfelParameters.from_scene(scene)
    tracer = SurfelTracer(scene, parameters=parameters)
    camera = Camera.look_at((2.5, 1, 0.7), (0, 0, 0), fov_deg=50, width=12, height=8)
    moved = dataclasses.replace(scene, means=scene.means + np.float32([0.1, -0.2, 0.3]))
    parameters.means = mi.Float(moved.means.ravel())
    tracer.update()
    expected = SurfelTracer(moved).gbuffer(camera).numpy()
    np.testing.assert_allclose(tracer.gbuffer(camera).numpy()["rgb"], expected["rgb"], atol=1e-6)
    with pytest.raises(TronError, match="follows parameters"):
        tracer.moved(moved)


def test_shadowed_irradiance_is_differentiable_by_opacity_on_request(disks):
    """A disk above a floor point, straight under a light: less of it arrives the more opaque the disk."""
    scene = disks([[0, 0, 1.0]], [False], opacity=0.6, sigma=2.0)
    light = EnvironmentLight(EnvironmentMap.constant(1.0))
    point = SimpleNamespace(
        position=mi.Point3f(0, 0, 0),
        normal=mi.Normal3f(0, 0, 1),
        opacity=mi.Float(1),
        pixel=mi.UInt32(0),
        width=1,
        height=1,
    )

    def arriving(logit: float, by_opacity: bool):
        scene.opacity_logits[:] = logit
        tracer, parameters = tracer_and_parameters(scene)
        transport = Transport.trace(tracer, point, light, 64, 0, by_opacity=by_opacity)
        return transport.irradiance(light)[0].x, parameters

    found, parameters = arriving(0.4, by_opacity=True)
    dr.backward(found)
    step = 1e-2
    ends = [float(arriving(0.4 + sign * step, by_opacity=False)[0][0]) for sign in (1, -1)]
    expected = (ends[0] - ends[1]) / (2 * step)
    assert expected < -0.05
    assert float(dr.grad(parameters.opacity_logits)[0]) == pytest.approx(expected, rel=0.02)
    assert not dr.grad_enabled(arriving(0.4, by_opacity=False)[0])
