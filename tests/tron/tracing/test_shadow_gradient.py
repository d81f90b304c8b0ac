"""Laws of the gradient of shadows by opacity: float64 differences, and zeros where zeros are due."""

# pyright: reportOperatorIssue=false, reportArgumentType=false
# (Mitsuba's type stubs know neither arithmetic between its own array types nor its aliases of Dr.Jit's.)

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.tracing import SurfelTracer, reference
from tron.tracing.parameters import PARAMETERS, SurfelParameters

pytestmark = pytest.mark.usefixtures("variant")

STEP = 1e-6


def tracer_and_parameters(scene, *, two_sided: bool = True) -> tuple[SurfelTracer, SurfelParameters]:
    parameters = SurfelParameters.from_scene(scene)
    for name in PARAMETERS:
        dr.enable_grad(getattr(parameters, name))
    return SurfelTracer(scene, two_sided=two_sided, parameters=parameters), parameters


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
