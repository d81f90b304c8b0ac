"""Shadowed irradiance as a linear function of the light, for fixed rays: what fitting a light needs.

The rays of :mod:`tron.shading.irradiance`, the same estimator and the same weights, are traced once and kept
with their visibility, one lane a ray. Irradiance / pi is then a weighted sum of looked-up radiance: gradients
reach the light's texels and, on request, the opacities that cast shadows; they stop at directions and
densities. Memory grows with pixels x rays;
where no gradient is wanted, :func:`tron.shading.irradiance` stores nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import drjit as dr
import mitsuba as mi

from tron.errors import TronError
from tron.shading.irradiance import ORIGIN_OFFSET, Light, Occluder, RayPlan, shadow_ray

if TYPE_CHECKING:
    from tron.tracing import GBuffer, SurfelTracer


@dataclass
class Transport:
    """Shadow rays with their visibility, pixel-major: lane = pixel x ``per_pixel`` + ray.

    Attributes:
        direction: unit, world.
        weight: what a ray's radiance is multiplied by on its way into unshadowed irradiance / pi.
        visibility: transmittance of what stands in the way.
        per_pixel: rays of a pixel.
    """

    direction: mi.Vector3f
    weight: mi.Float
    visibility: mi.Float
    per_pixel: int

    @classmethod
    def trace(
        cls,
        tracer: Occluder,
        gbuffer: GBuffer,
        light: Light,
        spp: int,
        seed: int,
        by_opacity: bool = False,
    ) -> Transport:
        """Draw and trace rays as :func:`tron.shading.irradiance` does; ``light`` only chooses directions.

        Args:
            tracer, gbuffer, spp, seed: as there; pixels of opacity 0 get rays of weight 0.
            light: what half the rays are drawn from.
            by_opacity: let gradients reach the opacities of the surfels that cast the shadows, which the
                paper does not; ``tracer`` must then be a ``SurfelTracer`` of differentiable parameters.

        Raises:
            TronError: ``spp`` is odd or not positive, or there are more rays than 32-bit indices address.
        """
        plan = RayPlan.make(spp, seed, gbuffer.width)
        pixels = dr.width(gbuffer.opacity)
        if pixels * spp >= 1 << 32:
            raise TronError(f"{pixels} pixels of {spp} rays are too many at once", mend="take fewer pixels")
        lane = dr.arange(mi.UInt32, pixels * spp)
        rays = dr.opaque(mi.UInt32, plan.rays)
        pixel, ray = lane // rays, lane % rays
        in_rows = dr.gather(mi.UInt32, gbuffer.pixel, pixel)

        def spread(value: mi.Point3f) -> mi.Point3f:
            return type(value)(*[dr.gather(mi.Float, channel, pixel) for channel in value])

        with dr.suspend_grad():
            normal = mi.Normal3f(spread(gbuffer.normal))
            surface = dr.gather(mi.Float, gbuffer.opacity, pixel) > 0
            direction, weight = shadow_ray(light, mi.Frame3f(normal), plan, in_rows, ray)
            counts = surface & (weight > 0)
            offset = dr.opaque(mi.Float, ORIGIN_OFFSET * tracer.scene.spacing)
            origin = spread(gbuffer.position) + normal * offset
            weight = dr.select(counts, weight, 0) / mi.Float(plan.count)
            dr.eval(direction, weight, origin, counts)
        if by_opacity:
            visibility = cast("SurfelTracer", tracer).transmittance_by_opacity(origin, direction, counts)
        else:
            (visibility,) = tracer.transmittances(origin, [direction], [counts])
        dr.eval(visibility)
        return cls(direction, weight, visibility, spp)

    def irradiance(self, light: Light) -> tuple[mi.Color3f, mi.Color3f]:
        """Shadowed and unshadowed irradiance / pi of each pixel, linear in ``light`` and differentiable."""
        found = light.radiance(self.direction) * self.weight

        def of_pixels(value: mi.Color3f) -> mi.Color3f:
            return mi.Color3f(*[dr.block_sum(channel, self.per_pixel) for channel in value])

        return of_pixels(found * self.visibility), of_pixels(found)
