"""Share of the unshadowed irradiance that reaches each point, as an :class:`Estimation` has it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import drjit as dr
import mitsuba as mi

from tron.estimation import Estimation
from tron.shading.denoise import atrous
from tron.shading.few_rays import RATIO_FROM_RAYS, grey, regressed_share
from tron.shading.irradiance import Occluder, irradiance, visible_share
from tron.shading.lighting import Lighting

if TYPE_CHECKING:
    from tron.tracing import GBuffer, Surface


class Shadows(Protocol):
    """Shadow rays of either sidedness: :class:`tron.tracing.SurfelTracer`, or a closed form in a test."""

    def sided(self, two_sided: bool) -> Occluder: ...


def visibility(
    tracer: Shadows, gbuffer: GBuffer, lighting: Lighting, estimation: Estimation, seed: int
) -> mi.Color3f:
    """Share of the unshadowed irradiance that reaches each pixel, by channel in [0, 1].

    Args:
        tracer: what casts shadows.
        gbuffer: positions, unit normals and opacity of the pixels.
        lighting: the prepared environment.
        estimation: how.
        seed: root of the shadow rays' random numbers.
    """
    occluder = tracer.sided(estimation.two_sided)
    found = irradiance(occluder, gbuffer, lighting.light, estimation.rays, seed)
    return reaching_share(*found, gbuffer, lighting, occluder.scene.spacing, estimation)


def reaching_share(
    shadowed: mi.Color3f,
    unshadowed: mi.Color3f,
    gbuffer: GBuffer,
    lighting: Lighting,
    spacing: float,
    estimation: Estimation,
) -> mi.Color3f:
    """The same from what the rays found: :func:`tron.shading.irradiance`'s two estimates."""
    plain, many = estimation.estimator == "plain", estimation.rays >= RATIO_FROM_RAYS
    if many and not (plain or estimation.filtered):
        return visible_share(shadowed, unshadowed)
    known = lighting.split_sum.diffuse(shading_normal(gbuffer))
    if estimation.filtered or not plain:
        share = regressed_share(shadowed, unshadowed, known, gbuffer, spacing)
        if not estimation.filtered:
            return share
        shadowed, unshadowed = atrous(shadowed, unshadowed, grey(share), gbuffer, spacing)
    return visible_share(shadowed, known if plain else unshadowed)


def shading_normal(surface: Surface) -> mi.Vector3f:
    """Unit world normals, up where there is no surface."""
    # An empty pixel has no normal, and 0 / 0 must not reach a lookup.
    return dr.select(surface.opacity > 0, mi.Vector3f(surface.normal), mi.Vector3f(0, 0, 1))
