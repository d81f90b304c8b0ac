"""Shadowed irradiance by multiple importance sampling: half the rays follow the cosine, half the light.

With n rays of each kind, every ray of direction w, whichever way it was drawn, adds

    L(w) V(w) p_cosine(w) / (n (p_cosine(w) + p_light(w))),      p_cosine = (N.w)+ / pi

which is the balance heuristic (Veach 1997); V is the transmittance of what stands in the way. The sum is E
/ pi, the radiance of a white diffuse surface. Points are stratified in either unit square and jittered by a
hash of pixel and ray: pixels are independent of each other and of the order in which they are traced.

All rays of a pixel run in one lane of one kernel: nothing is stored per ray, so memory does not grow with the
ray count. (A wavefront of rays, with those of no consequence compacted away, took the same time.)
"""

# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false, reportReturnType=false
# (Mitsuba's type stubs know neither arithmetic between its own array types nor its aliases of Dr.Jit's.)

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

import drjit as dr
import mitsuba as mi

from tron.errors import TronError
from tron.seeds import integer

if TYPE_CHECKING:
    from tron.gaussians.scene import GaussianScene
    from tron.tracing import GBuffer

ORIGIN_OFFSET = 0.1
"""Shadow rays start this many surfel spacings above the surface; from 0.05 to 0.15 nothing changes."""

BELOW_ONE = 1 - 2**-24

Strategy = Literal["mis", "cosine", "light"]


class Occluder(Protocol):
    """What stands in the way of light: :class:`tron.tracing.SurfelTracer`, or a closed form in a test."""

    scene: GaussianScene

    def transmittance(self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float: ...


class Light(Protocol):
    """Radiance from afar that can be drawn from: :class:`tron.shading.EnvironmentLight`, or a cubemap."""

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
) -> tuple[mi.Color3f, mi.Color3f]:
    """Shadowed and unshadowed irradiance / pi at every pixel with a surface (opacity > 0); 0 elsewhere.

    Both are unbiased and come from the same rays, so the noise of the light cancels in their ratio: where
    nothing is in the way the ratio is exactly 1, in the umbra exactly 0. Rays that carry nothing (below the
    horizon, black light) are not traced.

    Args:
        tracer: what blocks light; ``tracer.scene.spacing`` gives the offset of the rays' origins.
        gbuffer: positions and unit normals, world.
        light: the environment.
        spp: shadow rays a pixel, even: half of each kind (all of one kind where ``strategy`` says so).
        seed: root of the rays' random numbers.
        strategy: "mis", or one kind of ray alone, for comparison.

    Returns:
        (shadowed, unshadowed), linear, row-major as the G-buffer.

    Raises:
        TronError: ``spp`` is odd or not positive.
    """
    plan = RayPlan.make(spp, seed, strategy)
    offset = dr.opaque(mi.Float, ORIGIN_OFFSET * tracer.scene.spacing)
    shadowed, unshadowed = _accumulate(tracer, gbuffer, light, plan, offset)
    dr.eval(shadowed, unshadowed)
    return shadowed, unshadowed


@dataclass
class RayPlan:
    """How many rays of which kind a pixel sends; ``count`` of each kind, in ``columns`` x ``rows`` strata."""

    rays: mi.UInt32
    count: mi.UInt32
    columns: mi.UInt32
    rows: mi.UInt32
    by_cosine: mi.Float
    by_light: mi.Float
    stream: mi.UInt32

    @classmethod
    def make(cls, spp: int, seed: int, strategy: Strategy = "mis") -> RayPlan:
        """The plan for arguments as :func:`irradiance` has them.

        Raises:
            TronError: ``spp`` is odd or not positive.
        """
        if spp < 2 or spp % 2:
            raise TronError(f"spp is {spp}", mend="give an even number of shadow rays, 2 or more")
        n = spp // 2 if strategy == "mis" else spp
        rows = max(r for r in range(1, math.isqrt(n) + 1) if n % r == 0)
        # Opaque numbers, so that seeds, ray counts and scenes share one compiled kernel.
        return cls(
            rays=dr.opaque(mi.UInt32, 2 * n if strategy == "mis" else n),
            count=dr.opaque(mi.UInt32, n),
            columns=dr.opaque(mi.UInt32, n // rows),
            rows=dr.opaque(mi.UInt32, rows),
            by_cosine=dr.opaque(mi.Float, float(strategy != "light")),
            by_light=dr.opaque(mi.Float, float(strategy != "cosine")),
            stream=dr.opaque(mi.UInt32, integer(seed, "irradiance")),
        )

    def point(self, pixel: mi.UInt32, ray: mi.UInt32) -> mi.Point2f:
        """Jittered point of a ray's stratum in [0, 1)^2."""
        # Mitsuba's default of 4 rounds correlates neighbours at 0.4, seen as streaks; from 6 there is none.
        jitter_x, jitter_y = mi.sample_tea_32(pixel, self.stream + ray, 8)
        stratum = ray % self.count
        u = mi.Point2f(
            (mi.Float(stratum % self.columns) + mi.Float(jitter_x) * 2.0**-32) / mi.Float(self.columns),
            (mi.Float(stratum // self.columns) + mi.Float(jitter_y) * 2.0**-32) / mi.Float(self.rows),
        )
        return dr.minimum(u, BELOW_ONE)


def shadow_ray(
    light: Light, frame: mi.Frame3f, plan: RayPlan, pixel: mi.UInt32, ray: mi.UInt32
) -> tuple[mi.Vector3f, mi.Float]:
    """The estimator of one ray: its unit world direction and the weight of the radiance that it finds.

    The weighted radiances of all rays of a plan, over ``plan.count``, sum to irradiance / pi. The weight is 0
    below the horizon.
    """
    u = plan.point(pixel, ray)
    towards_light, _ = light.sample(u)
    direction = dr.select(
        (ray >= plan.count) | (plan.by_cosine == 0),
        towards_light,
        frame.to_world(mi.warp.square_to_cosine_hemisphere(u)),
    )
    cosine_pdf = dr.dot(frame.n, direction) * dr.inv_pi
    density = plan.by_cosine * cosine_pdf + plan.by_light * light.pdf(direction)
    return direction, dr.select(cosine_pdf > 0, cosine_pdf / density, 0)


@dr.syntax
def _accumulate(
    tracer: Occluder, gbuffer: GBuffer, light: Light, plan: RayPlan, offset: mi.Float
) -> tuple[mi.Color3f, mi.Color3f]:
    normal = mi.Normal3f(gbuffer.normal)
    frame = mi.Frame3f(normal)
    origin = gbuffer.position + normal * offset
    surface = gbuffer.opacity > 0
    pixel = dr.arange(mi.UInt32, dr.width(surface))
    shadowed, unshadowed = mi.Color3f(0), mi.Color3f(0)
    ray = mi.UInt32(0)
    while ray < plan.rays:
        direction, weight = shadow_ray(light, frame, plan, pixel, ray)
        radiance = light.radiance(direction)
        counts = surface & (weight > 0) & (dr.max(radiance) > 0)
        value = dr.select(counts, radiance * weight, 0)
        unshadowed += value
        shadowed += value * tracer.transmittance(origin, direction, counts)
        ray += 1
    scale = dr.rcp(mi.Float(plan.count))
    return shadowed * scale, unshadowed * scale
