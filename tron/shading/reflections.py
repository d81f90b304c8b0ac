"""What glossy surfaces mirror: rays of each pixel's lobe that meet the scene or escape.

Half vectors are drawn from the normals that the view sees (Heitz 2018, "Sampling the GGX Distribution of
Visible Normals"); a ray l then has the weight F(v.h) G_1(l), with Smith's masking in its separable form as
Mitsuba has it. Each ray is stopped by one surfel (:mod:`tron.tracing.first_hit`). With L the environment's
radiance and R what a surfel sends back along the ray,

    o = sum_escaped w L / sum w L        share of the environment's light that escapes
    M = sum_met w R / sum w              mean radiance over the lobe of what is met

by channel: the split sum, which has no noise, keeps the light, the rays decide how much of it is hidden. R is
the composition of :mod:`tron.shading.composition` at the surfel's centre with the bake's light, so a mirror
shows highlights of what it mirrors. A back face shows ``BACK`` of what its front sends out.

A few rays see a sun seldom: then o is the sky's, and a sun's highlight may stand in a shadow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from tron.estimation import Diffuse
from tron.seeds import integer
from tron.shading.bounce import BACK, BouncedLight
from tron.shading.composition import Bounced, Response
from tron.shading.irradiance import ORIGIN_OFFSET
from tron.shading.lighting import Lighting
from tron.shading.reflectance import fresnel
from tron.shading.sampling import PixelPoints
from tron.tracing.centres import centres
from tron.tracing.first_hit import NOTHING, FirstHit, ray_seeds

if TYPE_CHECKING:
    from tron.tracing import GBuffer, SurfelTracer

SMOOTHEST = 0.02
"""Least roughness of the rays: below, a lobe is narrower than float32 can draw."""


def reflections(
    tracer: SurfelTracer,
    gbuffer: GBuffer,
    lighting: Lighting,
    bounce: BouncedLight,
    rays: int,
    seed: int,
    diffuse: Diffuse = "principled",
) -> tuple[mi.Color3f, mi.Color3f]:
    """The share o of the lobe's light that escapes and the mean radiance M of what is met, by pixel.

    Rays stand still where the surface is differentiated, and what they find is a constant.

    Args:
        tracer: the scene.
        gbuffer: the pixels.
        lighting: the prepared environment.
        bounce: what it is at each surfel.
        rays: of each pixel.
        seed: root of their random numbers.
        diffuse: the model of the material.
    """
    with dr.suspend_grad():
        points = PixelPoints.make(rays, 1, gbuffer.width, seed, "reflections")
        root = dr.opaque(mi.UInt32, integer(seed, "reflections", "stops"))
        offset = dr.opaque(mi.Float, ORIGIN_OFFSET * tracer.scene.spacing)
        pixel, frame = gbuffer.pixel, mi.Frame3f(gbuffer.normal)
        view = frame.to_local(-gbuffer.direction)
        seen = (gbuffer.opacity > 0) & (view.z > 0)
        origin, run = gbuffer.position + gbuffer.normal * offset, points.run(pixel)
        alpha = dr.square(dr.maximum(gbuffer.roughness, SMOOTHEST))
        dr.eval(pixel, frame, view, seen, origin, run, alpha)
        sums = [dr.zeros(mi.Color3f, dr.width(pixel)) for _ in range(4)]
        dr.make_opaque(sums)
        for first in range(0, rays, points.fan):
            ray = dr.opaque(mi.UInt32, first)
            directions, weights, active, seeds = [], [], [], []
            for k in range(points.fan):
                half = visible_normal(view, alpha, points.point(run, ray + k, mi.UInt32(0)))
                facing = dr.dot(view, half)
                out = 2 * facing * half - view
                counts = seen & (facing > 0) & (out.z > 0)
                weight = fresnel(gbuffer, facing, diffuse) * masking(out.z, alpha)
                directions.append(frame.to_world(out))
                weights.append(dr.select(counts, weight, 0))
                active.append(counts)
                seeds.append(ray_seeds(root, pixel, ray + k))
            dr.eval(directions, weights, active, seeds)
            hits = tracer.first_hits(origin, directions, active, seeds)
            for direction, weight, hit in zip(directions, weights, hits, strict=True):
                met = hit.surfel != NOTHING
                radiance = weight * lighting.light.radiance(direction)
                returned = _returned(tracer, hit, direction, lighting, bounce, diffuse)
                terms = (weight, dr.select(met, weight * returned, 0), radiance, dr.select(met, 0, radiance))
                for total, term in zip(sums, terms, strict=True):
                    total += term
            dr.eval(sums)
        weight, met, light, escaped = sums
        openness, mirrored = _ratio(escaped, light, 1), _ratio(met, weight, 0)
        dr.eval(openness, mirrored)
    return openness, mirrored


def _ratio(part: mi.Color3f, whole: mi.Color3f, otherwise: float) -> mi.Color3f:
    pairs = zip(part, whole, strict=True)
    return mi.Color3f(*[dr.select(b > 0, a / dr.select(b > 0, b, 1), otherwise) for a, b in pairs])


def _returned(
    tracer: SurfelTracer,
    hit: FirstHit,
    direction: mi.Vector3f,
    lighting: Lighting,
    bounce: BouncedLight,
    diffuse: Diffuse,
) -> mi.Color3f:
    """Radiance that what is met sends back along ``direction``; 0 where nothing is."""
    met = hit.surfel != NOTHING
    front = met & hit.front

    def of(color: mi.Color3f, lanes: mi.Bool) -> mi.Color3f:
        return mi.Color3f(*[dr.gather(mi.Float, channel, hit.surfel, lanes) for channel in color])

    surface = centres(tracer.records, hit.surfel, front)
    surface.direction = direction
    indirect = of(bounce.indirect, front)
    openness = mi.Color3f(dr.gather(mi.Float, bounce.openness, hit.surfel, front))
    response = Response.of(surface, lighting.split_sum, diffuse)
    shown = response.lit(of(bounce.direct, front), Bounced(indirect, openness, indirect))
    return dr.select(hit.front, shown, BACK * of(bounce.outgoing, met & ~hit.front))


def visible_normal(view: mi.Vector3f, alpha: mi.Float, u: mi.Point2f) -> mi.Vector3f:
    """Half vector by the GGX normals that ``view`` sees, both unit and local; Heitz 2018, listing 1."""
    stretched = dr.normalize(mi.Vector3f(alpha * view.x, alpha * view.y, view.z))
    length2 = dr.square(stretched.x) + dr.square(stretched.y)
    aslant = length2 > 1e-12
    inverse = dr.rsqrt(dr.select(aslant, length2, 1))
    across = dr.select(
        aslant, mi.Vector3f(-stretched.y * inverse, stretched.x * inverse, 0), mi.Vector3f(1, 0, 0)
    )
    along = dr.cross(stretched, across)
    radius = dr.sqrt(u.x)
    sin, cos = dr.sincos(u.y * float(2 * dr.pi))
    x, y, squeeze = radius * cos, radius * sin, 0.5 * (1 + stretched.z)
    y = (1 - squeeze) * dr.safe_sqrt(1 - x * x) + squeeze * y
    normal = x * across + y * along + dr.safe_sqrt(1 - x * x - y * y) * stretched
    return dr.normalize(mi.Vector3f(alpha * normal.x, alpha * normal.y, dr.maximum(normal.z, 1e-6)))


def masking(cosine: mi.Float, alpha: mi.Float) -> mi.Float:
    """Smith's G_1 of GGX at ``cosine`` to the normal."""
    alpha2 = dr.square(alpha)
    return 2 * cosine / (cosine + dr.safe_sqrt(alpha2 + (1 - alpha2) * dr.square(cosine)))
