"""Laws of lit's gradients: by materials of all surfels and texels of the light they are the differences."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.cameras import Camera
from tron.errors import TronError
from tron.estimation import Estimation
from tron.seeds import generator
from tron.shading.bounce import BounceTransport
from tron.shading.cubemap import CubemapLight
from tron.shading.environment import EnvironmentMap
from tron.shading.fixed_rays import FixedRays
from tron.shading.guidance import Lighting, render_guidance
from tron.tracing import SurfelTracer
from tron.tracing.parameters import SurfelParameters

VIEW = Camera.look_at((1.5, -2.5, 1.6), (0, 0, 0.3), fov_deg=40, width=24, height=24)
ESTIMATION = Estimation(rays=16)


def scene_of(dense: Any, spacing: float = 0.15) -> Any:
    """A ball close to a floor, of random materials away from the kinks of the levels."""
    sheets = [dense.plane(spacing, 1.0), dense.sphere(spacing, 0.5, 0.55)]
    count = sum(len(sheet.points) for sheet in sheets)
    random = generator(0, "tests", "materials")
    return dense.scene(
        *sheets,
        spacing=spacing,
        base_color=random.uniform(0.3, 0.7, (count, 3)),
        roughness=np.full(count, 0.43),
        metallic=random.uniform(0.2, 0.6, count),
    )


@pytest.fixture
def texels(variant: str, cubemap_of) -> np.ndarray:
    bands = generator(1, "tests", "bands").random((4, 8, 3)).astype(np.float32) + np.float32(0.1)
    return np.array(cubemap_of(EnvironmentMap(bands).resized(32), 16).texels)


def light_of(texels: Any) -> Lighting:
    return Lighting(CubemapLight(mi.Float(texels), 16), 64)


def test_fixed_rays_show_what_the_frame_shows(dense_surfels, texels) -> None:
    tracer, lighting = SurfelTracer(scene_of(dense_surfels, 0.05)), light_of(texels)
    transport = BounceTransport.trace(tracer)
    fixed = FixedRays.trace(tracer, VIEW, lighting.light, transport, ESTIMATION, seed=3)
    gbuffer, colors = fixed.shade(lighting)
    bounce = transport.bake(lighting, ESTIMATION)
    frame = render_guidance(tracer, VIEW, lighting, ESTIMATION, 3, bounce=bounce)
    np.testing.assert_allclose(gbuffer.image(colors["shadowed"]), frame.shadowed, rtol=1e-3, atol=1e-4)
    found, inside = gbuffer.image(colors["lit"]), frame.mask > 0.99
    # Surfels' 8 rays are a ratio here and a regression there.
    assert found[inside].mean() == pytest.approx(frame.lit[inside].mean(), rel=0.01)
    assert np.median(np.abs(found - frame.lit)[inside]) < 0.02 * frame.lit[inside].mean()
    assert (frame.lit - frame.shadowed)[inside].max() > 0.05 * frame.lit[inside].mean()


@pytest.mark.parametrize("name", ["texels", "base_color", "roughness", "metallic"])
def test_gradients_of_lit_are_the_differences(dense_surfels, texels, name: str) -> None:
    parameters = SurfelParameters.from_scene(scene_of(dense_surfels))
    tracer = SurfelTracer(scene_of(dense_surfels), parameters=parameters)
    transport = BounceTransport.trace(tracer)
    fixed = FixedRays.trace(tracer, VIEW, light_of(texels).light, transport, ESTIMATION)
    start = texels if name == "texels" else np.array(getattr(parameters, name))
    towards = generator(2, "tests", name).normal(size=start.shape).astype(np.float32)
    weight = mi.Color3f(generator(3, "tests", "weight").normal(size=(3, 24 * 24)).astype(np.float32))

    def loss(value: mi.Float) -> mi.Float:
        if name != "texels":
            setattr(parameters, name, value)
            tracer.update()
        _, colors = fixed.shade(light_of(value if name == "texels" else texels))
        return dr.sum(dr.dot(weight, colors["lit"]))

    step = 0.01
    ends = [float(loss(mi.Float(start + sign * step * towards))[0]) for sign in (1, -1)]
    value = mi.Float(start)
    dr.enable_grad(value)
    dr.backward(loss(value))
    gradient = np.array(dr.grad(value), np.float64)
    assert np.isfinite(gradient).all()
    scale = np.linalg.norm(gradient)  # a random direction's derivative is of its size
    assert gradient @ towards == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=0.02 * scale)
    if name == "base_color":  # surfels that the camera does not see have one, too: below the ball
        hidden = tracer.scene.means @ (VIEW.position - [0, 0, 0.55]) < 0
        below = (tracer.scene.means[:, 2] > 0.01) & (tracer.scene.normals()[:, 2] < -0.9) & hidden
        assert below.any()
        assert (np.abs(gradient.reshape(-1, 3)[below]).sum(1) > 0).mean() > 0.9


def test_a_cubemap_does_not_turn(texels) -> None:
    with pytest.raises(TronError, match="does not turn"):
        light_of(texels).turned_to(30.0)
