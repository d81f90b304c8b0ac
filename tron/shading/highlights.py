"""Highlights of previews: what smooth surfaces mirror of the environment, past what is in the way.

A preview sends reflection rays from metals alone. Other surfaces show the share of the environment that
escapes towards everywhere (:mod:`tron.shading.composition`). Smooth ones may mirror a sun that
walls hide, a thousand times as bright as all else: a floor of roughness 0.1 in a room was 47 times the truth.
Where the mirrored environment is much of what a pixel shows, and something is in the way of some of it, one
ray of the lobe and one of the light tell. With s and u what they find with and without what is in their way,
and S the split sum, which has no noise,

    o = (s + V (S - u)) / S,   within [0, 1]

What the two rays have missed of S arrives as irradiance does, by its share V.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from tron.brdf.reflectance import Layers
from tron.estimation import Brdf
from tron.seeds import integer
from tron.shading.bounces.bounce import BOUNCED_VALUES
from tron.shading.composition import Bounced, Response, evenly_bounced
from tron.shading.direct.irradiance import ORIGIN_OFFSET, Occluder
from tron.shading.lighting import Lighting
from tron.shading.reflections import Lobe, metal_share, ratio, ray_weights
from tron.tracing.hierarchy.first_hit import ray_seeds
from tron.tracing.surface import Surface

if TYPE_CHECKING:
    from tron.tracing import GBuffer

SMOOTH = (0.4, 0.6)
"""Roughness up to which rays count in full, and from which on there are none: V tells of wide lobes."""
OPEN = 0.97
"""Openness above which nothing is in the way."""
STRONG = (0.25, 0.5)
"""Mirrored environment over all other light of a pixel, from which on rays count, and count in full."""


@dataclass
class Highlights:
    """What rays find of the environment in pixels that mirror much of it.

    Attributes:
        openness: o, by channel.
        share: weight in [0, 1] of this o beside the even one.
    """

    openness: mi.Color3f
    share: mi.Float


def highlights(
    tracer: Occluder,
    gbuffer: GBuffer,
    lighting: Lighting,
    visibility: mi.Color3f,
    seed: int,
    brdf: Brdf = "conserving",
) -> Highlights | None:
    """The highlights of a preview; None where there are none that anything may hide.

    Args:
        tracer: the scene.
        gbuffer: the pixels, with the values of a bake.
        lighting: the prepared environment.
        visibility: V, share of the unshadowed irradiance that reaches each pixel.
        seed: root of the rays' random numbers.
        brdf: the model of the material.
    """
    with dr.suspend_grad():
        openness = gbuffer.values[BOUNCED_VALUES - 1]
        smooth = (gbuffer.opacity > 0) & (gbuffer.roughness < SMOOTH[1]) & (metal_share(gbuffer) < 1)
        lane = dr.compress(smooth & (openness < OPEN))
        if dr.width(lane) == 0:
            return None
        surface, arriving = _some_of(gbuffer, visibility, lane)
        response = Response.of(surface, lighting.split_sum, brdf)
        even = evenly_bounced(
            mi.Color3f(*surface.values[:3]), surface.values[BOUNCED_VALUES - 1], arriving, surface.roughness
        )
        mirrored = even.openness * response.specular
        other = response.lit(response.unshadowed * arriving, even) - mirrored
        strength = dr.max(mirrored) / dr.maximum(dr.max(other), 1e-6)
        share = dr.clip((strength - STRONG[0]) / (STRONG[1] - STRONG[0]), 0, 1)
        share *= dr.clip((SMOOTH[1] - surface.roughness) / (SMOOTH[1] - SMOOTH[0]), 0, 1)
        some = dr.compress(share > 0)
        if dr.width(some) == 0:
            return None
        lane, share = dr.gather(mi.UInt32, lane, some), dr.gather(mi.Float, share, some)
        surface, arriving = _some_of(gbuffer, visibility, lane)
        pixel = dr.gather(mi.UInt32, gbuffer.pixel, lane)
        found = _escaping(tracer, surface, arriving, pixel, lighting, seed, brdf)
        every = Highlights(*(dr.zeros(kind, dr.width(gbuffer.opacity)) for kind in (mi.Color3f, mi.Float)))
        dr.scatter(every, Highlights(found, share), lane)
        dr.eval(every)
    return every


def _some_of(gbuffer: GBuffer, visibility: mi.Color3f, lane: mi.UInt32) -> tuple[Surface, mi.Color3f]:
    """Pixels by their lanes."""
    surface = Surface(**{field.name: getattr(gbuffer, field.name) for field in fields(Surface)})
    return dr.gather(Surface, dr.detach(surface), lane), dr.gather(mi.Color3f, visibility, lane)


def _escaping(
    tracer: Occluder,
    surface: Surface,
    visibility: mi.Color3f,
    pixel: mi.UInt32,
    lighting: Lighting,
    seed: int,
    brdf: Brdf,
) -> mi.Color3f:
    """o of surfaces, by one ray of the lobe and one of the light."""
    table = lighting.split_sum.brdf
    lobe, root = Lobe.of(surface, table), dr.opaque(mi.UInt32, integer(seed, "highlights"))
    seeds = ray_seeds(root, pixel, dr.opaque(mi.UInt32, 0))
    u = [mi.sample_tea_float32(seeds, mi.UInt32(k)) for k in range(4)]
    directions = [lobe.draw(mi.Point2f(*u[:2]))[0], lighting.light.sample(mi.Point2f(*u[2:]))[0]]
    layers = Layers.of(surface, table, lobe.view.z) if brdf == "conserving" else None
    offset, normal = dr.opaque(mi.Float, ORIGIN_OFFSET * tracer.scene.spacing), mi.Vector3f(surface.normal)
    origin, seen = surface.raised(offset), lobe.view.z > 0
    weights = [ray_weights(lobe, along, seen, surface, lighting, brdf, layers) for along in directions]
    values = [share * radiance * lobe.albedo for _, share, radiance in weights]
    active = [dr.max(value) > 0 for value in values]
    specular = Response.of(surface, lighting.split_sum, brdf).specular
    dr.eval(directions, values, active, origin, normal, specular)
    visible = tracer.transmittances(origin, directions, active, normal)
    escaped = sum((value * each for value, each in zip(values, visible, strict=True)), mi.Color3f(0))
    missed = specular - sum(values, mi.Color3f(0))
    share = ratio(escaped + dr.minimum(visibility, 1) * missed, specular, 1)
    return dr.clip(share, 0, 1)


def with_highlights(even: Bounced, found: Highlights) -> Bounced:
    """Light that bounced; of the environment's what rays found."""
    return Bounced(even.indirect, dr.lerp(even.openness, found.openness, found.share), even.mirrored)
