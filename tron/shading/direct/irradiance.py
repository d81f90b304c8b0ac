"""Shadowed irradiance by multiple importance sampling: half the rays follow the cosine, half the light.

With n rays of each kind, every ray of direction w, whichever way it was drawn, adds

    L(w) V(w) p_cosine(w) / (n (p_cosine(w) + p_light(w))),      p_cosine = (N.w)+ / pi

which is the balance heuristic (Veach 1997); V is the transmittance along the ray. The sum is E / pi, the
radiance of a white diffuse surface. Points in either unit square come from
:mod:`tron.shading.direct.sampling`.

Lanes are those of the G-buffer, pixels in tile order. A lane traces up to four rays of neighbouring strata
at once: rays that start and point close together share most of their way through the hierarchy. One kernel
traces one such fan for every pixel and is launched again for the next, so memory does not grow with the ray
count. (The loop over rays inside the kernel was three times as slow.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

import drjit as dr
import mitsuba as mi

from tron.errors import TronError
from tron.shading.direct.sampling import PixelPoints
from tron.tracing.hierarchy.transmittance import Fans

if TYPE_CHECKING:
    from tron.gaussians.scene import GaussianScene
    from tron.tracing import GBuffer

ORIGIN_OFFSET = 0.1
"""Shadow rays start this many surfel spacings above the surface; from 0.05 to 0.15 nothing changes."""


class Observer(Protocol):
    """Accumulates its own sums over rays, such as :class:`tron.shading.direct.noise.NoiseSums`.

    For each fan it receives unit world directions, the weighted radiance along them, and the share of it
    that arrives.
    """

    def add(
        self, directions: Sequence[mi.Vector3f], light: Sequence[mi.Color3f], visible: Sequence[mi.Float]
    ) -> None: ...


Strategy = Literal["mis", "cosine", "light"]


class Occluder(Protocol):
    """Occluder of light: :class:`tron.tracing.SurfelTracer`, or a closed form in a test."""

    scene: GaussianScene

    def transmittances(self, fans: Fans) -> list[mi.Float]: ...


class Light(Protocol):
    """Environment that can be sampled: :class:`tron.shading.EnvironmentLight`, or a cubemap."""

    def radiance(self, d: mi.Vector3f) -> mi.Color3f: ...

    def sample(self, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]: ...

    def pdf(self, d: mi.Vector3f) -> mi.Float: ...


def irradiance(
    tracer: Occluder,
    gbuffer: GBuffer,
    light: Light,
    spp: int,
    seed: int,
    strategy: Strategy = "mis",
    observers: Sequence[Observer] = (),
) -> tuple[mi.Color3f, mi.Color3f]:
    """Shadowed and unshadowed irradiance / pi at every pixel with a surface (opacity > 0); 0 elsewhere.

    Both are unbiased and come from the same rays, so the noise of the light cancels in their ratio: where
    nothing is in the way the ratio is exactly 1, in the umbra exactly 0. Rays that carry nothing (below the
    horizon, black light) are not traced.

    Args:
        tracer: what blocks light; ``tracer.scene.spacing`` gives the offset of the rays' origins.
        gbuffer: positions and unit normals, world.
        light: the environment.
        spp: shadow rays per pixel, even: half of each kind (all of one kind where ``strategy`` says so).
        seed: root of the rays' random numbers.
        strategy: "mis", or one kind of ray alone, for comparison.
        observers: receive every ray.

    Returns:
        (shadowed, unshadowed), linear, one lane each of the G-buffer's.

    Raises:
        TronError: ``spp`` is odd or not positive.
    """
    plan = RayPlan.make(spp, seed, gbuffer.width, strategy)
    # Rays are constants when the surface is differentiated.
    normal = mi.Vector3f(dr.detach(gbuffer.normal))
    offset = dr.opaque(mi.Float, ORIGIN_OFFSET * tracer.scene.spacing)
    origin = gbuffer.raised(offset)
    surface, frame, pixel = dr.detach(gbuffer.opacity) > 0, mi.Frame3f(mi.Normal3f(normal)), gbuffer.pixel
    dr.eval(pixel, surface, frame, origin, normal)
    lanes = dr.width(surface)
    shadowed, unshadowed = dr.zeros(mi.Color3f, lanes), dr.zeros(mi.Color3f, lanes)
    dr.make_opaque(shadowed, unshadowed)  # or the first launch would be a kernel of its own
    for first in range(0, plan.rays, plan.fan):
        ray = dr.opaque(mi.UInt32, first)
        directions, values, active = [], [], []
        for k in range(plan.fan):
            direction, weight = shadow_ray(light, frame, plan, pixel, ray + k)
            radiance = light.radiance(direction)
            counts = surface & (weight > 0) & (dr.max(radiance) > 0)
            directions.append(direction)
            active.append(counts)
            values.append(dr.select(counts, radiance * weight, 0))
        dr.eval(directions, values, active)  # tracers read the rays more than once
        visible = tracer.transmittances(Fans(origin, directions, active, normal))
        unshadowed += sum(values)
        shadowed += sum(value * share for value, share in zip(values, visible, strict=True))
        for observer in observers:
            observer.add(directions, values, visible)
        dr.eval(shadowed, unshadowed)
    scale = dr.rcp(mi.Float(plan.count))
    shadowed, unshadowed = shadowed * scale, unshadowed * scale
    dr.eval(shadowed, unshadowed)
    return shadowed, unshadowed


@dataclass
class RayPlan:
    """Rays of each kind that a pixel sends: ``count`` by the cosine, then ``count`` by the light."""

    rays: int
    count: mi.UInt32
    by_cosine: mi.Float
    by_light: mi.Float
    points: PixelPoints

    @classmethod
    def make(cls, spp: int, seed: int, width: int, strategy: Strategy = "mis") -> RayPlan:
        """The plan for arguments as :func:`irradiance` has them and an image ``width`` pixels across.

        Raises:
            TronError: ``spp`` is odd or not positive.
        """
        if spp < 2 or spp % 2:
            raise TronError(f"spp is {spp}", mend="give an even number of shadow rays, 2 or more")
        n = spp // 2 if strategy == "mis" else spp
        # Opaque numbers, so that seeds, ray counts and scenes share one compiled kernel.
        return cls(
            rays=2 * n if strategy == "mis" else n,
            count=dr.opaque(mi.UInt32, n),
            by_cosine=dr.opaque(mi.Float, float(strategy != "light")),
            by_light=dr.opaque(mi.Float, float(strategy != "cosine")),
            points=PixelPoints.make(n, 2, width, seed, "irradiance"),
        )

    @property
    def fan(self) -> int:
        """Rays that are traced together: consecutive and of one kind."""
        return self.points.fan


def visible_share(shadowed: mi.Color3f, unshadowed: mi.Color3f) -> mi.Color3f:
    """Share of the unshadowed light that arrives, by channel; 1 if there is no light."""
    return mi.Color3f(*[dr.select(u > 0, s / u, 1) for s, u in zip(shadowed, unshadowed, strict=True)])


def shadow_ray(
    light: Light, frame: mi.Frame3f, plan: RayPlan, pixel: mi.UInt32, ray: mi.UInt32
) -> tuple[mi.Vector3f, mi.Float]:
    """The estimator of one ray: its unit world direction and the weight of the radiance that it finds.

    The weighted radiances of all rays of a plan, over ``plan.count``, sum to irradiance / pi. The weight is 0
    below the horizon.

    Args:
        light: the environment.
        frame: about the pixel's normal.
        plan: of the image.
        pixel: row-major. ray: in [0, ``plan.rays``).
    """
    by_light = (ray >= plan.count) | (plan.by_cosine == 0)
    i = ray - dr.select(ray >= plan.count, plan.count, 0)
    u = plan.points.point(plan.points.run(pixel), i, dr.select(by_light, mi.UInt32(1), 0))
    direction = dr.select(
        by_light, light.sample(u)[0], frame.to_world(mi.warp.square_to_cosine_hemisphere(u))
    )
    cosine_pdf = dr.dot(frame.n, direction) * dr.inv_pi
    density = plan.by_cosine * cosine_pdf + plan.by_light * light.pdf(direction)
    return direction, dr.select(cosine_pdf > 0, cosine_pdf / density, 0)
