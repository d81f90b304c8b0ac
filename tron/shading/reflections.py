"""Reflections of the scene in glossy surfaces: rays of each pixel's lobe that meet the scene or escape.

Half vectors are drawn from the normals visible to the view v (Heitz 2018, "Sampling the GGX Distribution of
Visible Normals"). A mirrored direction l is kept with the probability G_2(v, l) / G_1(v) that no other facet
blocks it (:mod:`tron.brdf.microfacets`); otherwise another is drawn. So rays have the density
p(l) = D(h) G_2(v, l) / (4 n.v e), where e is the albedo of a perfect mirror, and equal weights except for
Fresnel's share F. With L the environment's radiance, V its visibility and R the radiance of a surfel,

    M = e / (n ks) sum_met F R               mean over the lobe of the radiance that is met
    o = sum m F L V / sum m F L              share of the environment's light that escapes

by channel, over n rays. The noiseless split sum gives the light; the rays only decide how much of it is
hidden. o also uses as many rays drawn from the light: few of the lobe's rays see a sun, and its highlight
would remain in shadows. m = p / (p + p_light) is the balance heuristic (Veach 1997), for rays of both kinds.
A pixel has few rays: if they were drawn by the normals alone and weighted afterwards, a tenth of the light
would be missing in a white bowl of rough metal. And a ratio of few rays is biased, so the sums of rougher
lobes are averaged over neighbouring pixels before the division.

A ray of the lobe is stopped by one surfel (:mod:`tron.tracing.hierarchy.first_hit`). R is the radiance by
:mod:`tron.shading.composition` at the surfel's centre with the baked light, so reflected surfaces show their
highlights. A back face has the radiance ``BouncedLight.behind``. Where a metal is met, one ray of its own
lobe is traced further; the surfel that it meets has the baked light only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from tron.brdf.microfacets import seen_density, unhidden, visible_normal
from tron.brdf.reflectance import LEAST_ALBEDO, Layers, Material, fresnel, reflectance
from tron.brdf.table import BrdfTable
from tron.estimation import Brdf, Estimation
from tron.seeds import integer
from tron.shading.bounces.bounce import BouncedLight
from tron.shading.composition import Bounced, Response, evenly_bounced, ratio
from tron.shading.direct.irradiance import ORIGIN_OFFSET
from tron.shading.direct.neighbours import neighbourhood_mean
from tron.shading.direct.sampling import PixelPoints
from tron.shading.lighting import Lighting
from tron.tracing.hierarchy.first_hit import NOTHING, FirstHit, ray_seeds
from tron.tracing.hierarchy.transmittance import Fans
from tron.tracing.surface import centres

if TYPE_CHECKING:
    from tron.tracing import GBuffer, Surface, SurfelTracer


TRIALS = 8
"""Directions tried per ray; in the roughest lobes one ray in a hundred keeps none and takes the likeliest."""
SMOOTHEST = 0.02
"""Least roughness of the rays: a narrower lobe cannot be sampled in float32."""
EVEN = (0.6, 0.9)
"""Roughness up to which a metal that is met traces a further ray, and above which bounced light is used."""
ROUGHER = 0.5
"""Share of a lobe's alpha by which the surface it meets is roughened for looking up the environment. A rough
floor's few rays seldom find the sun in a polished ball, and give white specks where they do (Kaplanyan and
Dachsbacher 2013, "Path Space Regularization for Holistic and Robust Light Transport")."""
ROUGH = 0.2
"""Roughness above which neighbours' rays count in full; a mirror uses only its own."""
UNLIKE = 10.0
"""Inverse of the difference in roughness at which a neighbour counts for 1 / e."""


@dataclass
class Mirror:
    """The light in a lobe, one lane per pixel, by channel.

    Attributes:
        openness: o, share of the environment's light that is not occluded.
        radiance: M, mean over the lobe of the radiance that is met, linear.
    """

    openness: mi.Color3f
    radiance: mi.Color3f


def reflections(
    tracer: SurfelTracer,
    gbuffer: GBuffer,
    lighting: Lighting,
    bounce: BouncedLight,
    rays: int,
    seed: int,
    brdf: Brdf = "conserving",
    where: mi.Bool | bool = True,
) -> Mirror:
    """Trace the lobe of each pixel.

    Rays and their results are constants when the surface is differentiated.

    Args:
        tracer: the scene.
        gbuffer: the pixels.
        lighting: the prepared environment.
        bounce: its light baked at each surfel.
        rays: per pixel.
        seed: root of their random numbers.
        brdf: the model of the material.
        where: the pixels to trace rays from.
    """
    with dr.suspend_grad():
        points = PixelPoints.make(rays, 2, gbuffer.width, seed, "reflections")
        root, again = (
            dr.opaque(mi.UInt32, integer(seed, "reflections", name)) for name in ("stops", "again")
        )
        offset = dr.opaque(mi.Float, ORIGIN_OFFSET * tracer.scene.spacing)
        table = lighting.split_sum.brdf
        pixel, lobe = gbuffer.pixel, Lobe.of(gbuffer, table)
        seen = where & (gbuffer.opacity > 0) & (lobe.view.z > 0)
        origin, run = gbuffer.raised(offset), points.run(pixel)
        normal = mi.Vector3f(gbuffer.normal)
        layers = Layers.of(gbuffer, table, lobe.view.z) if brdf == "conserving" else None
        share = reflectance(gbuffer, table, lobe.view.z, brdf).specular
        expected = share * (dr.opaque(mi.Float, rays) / lobe.albedo)
        dr.eval(pixel, lobe, seen, origin, run, normal, layers, expected)
        none = dr.zeros(mi.Color3f, dr.width(pixel))
        sums = {name: mi.Color3f(none) for name in ("met", "light", "escaped")}
        dr.make_opaque(sums)
        for first in range(0, rays, points.fan):
            fan = [dr.opaque(mi.UInt32, first) + k for k in range(points.fan)]
            drawn = [lobe.draw(points.point(run, ray, mi.UInt32(0))) for ray in fan]
            directions = [direction for direction, _ in drawn]
            active = [seen & counts for _, counts in drawn]
            seeds = [ray_seeds(root, pixel, ray) for ray in fan]
            dr.eval(directions, active, seeds)
            hits = tracer.first_hits(origin, directions, active, seeds, normal)
            for ray, direction, counts, hit in zip(fan, directions, active, hits, strict=True):
                weight, share, radiance = ray_weights(
                    lobe, direction, counts, gbuffer, lighting, brdf, layers
                )
                met = hit.surfel != NOTHING
                further = ray_seeds(again, pixel, ray)
                returned = _returned(tracer, hit, direction, lighting, bounce, brdf, further, lobe.alpha)
                sums["met"] += dr.select(met, weight * returned, 0)
                sums["light"] += share * radiance
                sums["escaped"] += dr.select(met, 0, share * radiance)
            dr.eval(sums)
            directions = [lighting.light.sample(points.point(run, ray, mi.UInt32(1)))[0] for ray in fan]
            found = [ray_weights(lobe, d, seen, gbuffer, lighting, brdf, layers) for d in directions]
            values = [share * radiance for _, share, radiance in found]
            active = [dr.max(value) > 0 for value in values]
            dr.eval(directions, values, active)
            reached = tracer.transmittances(Fans(origin, directions, active, normal))
            for value, visible in zip(values, reached, strict=True):
                sums["light"] += value
                sums["escaped"] += value * visible
            dr.eval(sums)
        sums["met"] = ratio(sums["met"], expected, 0)
        mirror = _pooled(sums, seen, gbuffer, tracer.scene.spacing)
        dr.eval(mirror)
    return mirror


def _pooled(sums: dict[str, mi.Color3f], seen: mi.Bool, gbuffer: GBuffer, spacing: float) -> Mirror:
    """Pool the sums of a pixel with its neighbours': the rougher the pixel, the more they count."""
    own = [dr.select(seen, value, 0) for color in sums.values() for value in color]
    own.append(dr.select(seen, mi.Float(1), 0))
    dr.eval(own)
    means, _ = neighbourhood_mean(own, gbuffer, spacing, guide=gbuffer.roughness, stop=UNLIKE)
    share = dr.select(seen, dr.clip(gbuffer.roughness / ROUGH, 0, 1), 0)
    *values, weight = [dr.lerp(one, mean, share) for one, mean in zip(own, means, strict=True)]
    met, light, escaped = (mi.Color3f(*values[k : k + 3]) for k in (0, 3, 6))
    return Mirror(ratio(escaped, light, 1), met / dr.maximum(weight, 1e-6))


@dataclass
class Lobe:
    """The GGX lobe towards a view, one lane per pixel.

    Attributes:
        frame: about the normal.
        view: unit, towards the camera, local.
        alpha: of the distribution.
        albedo: e, a perfect mirror's.
    """

    frame: mi.Frame3f
    view: mi.Vector3f
    alpha: mi.Float
    albedo: mi.Float

    @classmethod
    def of(cls, surface: Surface, table: BrdfTable) -> Lobe:
        """The lobe of a surface along its own rays."""
        frame, roughness = mi.Frame3f(surface.normal), dr.maximum(surface.roughness, SMOOTHEST)
        view = frame.to_local(-surface.direction)
        scale, bias, _, _ = table(roughness, view.z)
        return cls(frame, view, dr.square(roughness), dr.maximum(scale + bias, LEAST_ALBEDO))

    def draw(self, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Bool]:
        """A direction, world, and whether it is above the surface."""
        kept, out, best = mi.Bool(False), mi.Vector3f(0, 0, -1), mi.Float(0)
        bits = [dr.reinterpret_array(mi.UInt32, axis) for axis in u]
        for trial in range(TRIALS):
            half = visible_normal(self.view, self.alpha, u)
            facing = dr.dot(self.view, half)
            mirrored = 2 * facing * half - self.view
            above = (facing > 0) & (mirrored.z > 0)
            share = dr.select(above, unhidden(self.view.z, mirrored.z, self.alpha), 0)
            better = ~kept & (share > best)
            out, best = dr.select(better, mirrored, out), dr.select(better, share, best)
            chance, *fresh = [mi.sample_tea_float32(bits[0], bits[1] + 3 * trial + k) for k in range(3)]
            out, kept = dr.select(~kept & (chance < share), mirrored, out), kept | (chance < share)
            u = mi.Point2f(*fresh)  # only the first trial uses the pixel's own points
        return self.frame.to_world(out), out.z > 0

    def density(self, out: mi.Vector3f) -> mi.Float:
        """Density of :meth:`draw`, by solid angle, of a local direction above the surface."""
        half = dr.normalize(out + self.view)
        share = unhidden(self.view.z, dr.maximum(out.z, 0), self.alpha)
        return seen_density(self.view.z, half, self.alpha) * share / self.albedo


def ray_weights(
    lobe: Lobe,
    direction: mi.Vector3f,
    active: mi.Bool,
    material: Material,
    lighting: Lighting,
    brdf: Brdf,
    layers: Layers | None,
) -> tuple[mi.Color3f, mi.Color3f, mi.Color3f]:
    """F, m F and L of rays along ``direction``, drawn either way; F is 0 where inactive."""
    out = lobe.frame.to_local(direction)
    facing = dr.dot(lobe.view, dr.normalize(out + lobe.view))
    weight = dr.select(active & (out.z > 0) & (facing > 0), fresnel(material, facing, brdf, layers), 0)
    own, other = dr.select(out.z > 0, lobe.density(out), 0), lighting.light.pdf(direction)
    total = own + other
    balance = dr.select(total > 0, own / dr.select(total > 0, total, 1), 0)
    return weight, weight * balance, lighting.light.radiance(direction)


def _returned(
    tracer: SurfelTracer,
    hit: FirstHit,
    direction: mi.Vector3f,
    lighting: Lighting,
    bounce: BouncedLight,
    brdf: Brdf,
    seeds: mi.UInt32 | None = None,
    wide: mi.Float | None = None,
) -> mi.Color3f:
    """Radiance of the met surfels back along ``direction``; 0 where nothing is met.

    ``seeds``: of the further rays traced by metals that are met; None: none. ``wide``: alpha of the ray's own
    lobe (:data:`ROUGHER`); None: the met surface is not roughened.
    """
    met = hit.surfel != NOTHING
    front = met & hit.front

    def of(color: mi.Color3f, lanes: mi.Bool) -> mi.Color3f:
        return mi.Color3f(*[dr.gather(mi.Float, channel, hit.surfel, lanes) for channel in color])

    surface = centres(tracer.records, hit.surfel, front)
    surface.direction = direction
    looked_up = surface
    if wide is not None:
        alpha = dr.hypot(dr.square(surface.roughness), ROUGHER * wide)
        looked_up = replace(surface, roughness=dr.minimum(dr.sqrt(alpha), 1))
    direct, indirect = of(bounce.direct, front), of(bounce.indirect, front)
    response = Response.of(surface, lighting.split_sum, brdf, looked_up)
    openness = dr.gather(mi.Float, bounce.openness, hit.surfel, front)
    visibility = ratio(direct, response.unshadowed, 1)
    bounced = evenly_bounced(indirect, openness, visibility, surface.roughness, response)
    further = metal_share(surface) * dr.clip((EVEN[1] - surface.roughness) / (EVEN[1] - EVEN[0]), 0, 1)
    metal = front & (further > 0)
    if seeds is not None and dr.any(metal):
        mirror = _mirrored(tracer, hit.surfel, direction, metal, visibility, lighting, bounce, brdf, seeds)
        bounced = with_mirror(bounced, mirror, further)
    shown = response.lit(direct, bounced)
    if bounce.emitted is not None:
        shown += of(bounce.emitted, front)
    return dr.select(hit.front, shown, of(bounce.behind, met & ~hit.front))


def _mirrored(
    tracer: SurfelTracer,
    surfel: mi.UInt32,
    direction: mi.Vector3f,
    active: mi.Bool,
    visibility: mi.Color3f,
    lighting: Lighting,
    bounce: BouncedLight,
    brdf: Brdf,
    seeds: mi.UInt32,
) -> Mirror:
    """The light in the lobes of ``surfel`` along ``direction``, by one ray each; 0 where inactive.

    The ray decides how much of the environment is seen; in a rough lobe, the surfel's ``visibility`` does.
    """
    lane = dr.compress(active)
    surface = centres(tracer.records, dr.gather(mi.UInt32, surfel, lane))
    surface.direction = dr.gather(mi.Vector3f, direction, lane)
    arriving, seed = dr.gather(mi.Color3f, visibility, lane), dr.gather(mi.UInt32, seeds, lane)
    table = lighting.split_sum.brdf
    lobe, offset = Lobe.of(surface, table), dr.opaque(mi.Float, ORIGIN_OFFSET * tracer.scene.spacing)
    number = [mi.sample_tea_float32(seed, mi.UInt32(k)) for k in range(2)]
    along, above = lobe.draw(mi.Point2f(*number))
    above &= lobe.view.z > 0
    origin, normal = surface.raised(offset), mi.Vector3f(surface.normal)
    dr.eval(lobe, along, above, origin, normal, seed, arriving, surface)
    (hit,) = tracer.first_hits(origin, [along], [above], [seed], normal)
    layers = Layers.of(surface, table, lobe.view.z) if brdf == "conserving" else None
    expected = reflectance(surface, table, lobe.view.z, brdf).specular / lobe.albedo
    weight = ray_weights(lobe, along, above, surface, lighting, brdf, layers)[0]
    radiance = ratio(weight * _returned(tracer, hit, along, lighting, bounce, brdf), expected, 0)
    free = dr.select(hit.surfel == NOTHING, mi.Float(1), 0)
    open_share = dr.lerp(mi.Color3f(free), dr.minimum(arriving, 1), surface.roughness)
    found = Mirror(dr.zeros(mi.Color3f, dr.width(active)), dr.zeros(mi.Color3f, dr.width(active)))
    for target, value in ((found.openness, open_share), (found.radiance, radiance)):
        for channel, of_lanes in zip(target, value, strict=True):
            dr.scatter(channel, of_lanes, lane)
    dr.eval(found)
    return found


# A metal shows reflections only, so bounced light from all directions is too crude: a room of metal has 1.02,
# 1.17 and 1.51 of the true light by channel, with one ray 0.89, 0.96 and 1.10. Other surfaces keep
# that light, and scenes without metals cost nothing.

RAYS = 1


def metal_share(surface: Surface) -> mi.Float:
    """Weight in [0, 1] of the rays' results: 0 up to a metallic of one half, then linear."""
    return dr.clip(2 * surface.metallic - 1, 0, 1)


def metal_reflections(
    tracer: SurfelTracer,
    gbuffer: GBuffer,
    lighting: Lighting,
    bounce: BouncedLight,
    estimation: Estimation,
    seed: int,
) -> Mirror | None:
    """The light in each metal pixel's lobe, by few rays; None if there is no metal."""
    metal = (gbuffer.opacity > 0) & (metal_share(gbuffer) > 0)
    if not dr.any(metal):
        return None
    return reflections(tracer, gbuffer, lighting, bounce, RAYS, seed, estimation.brdf, metal)


def with_mirror(even: Bounced, mirror: Mirror, share: mi.Float) -> Bounced:
    """Blend reflection rays' results into bounced light by ``share``, such as :func:`metal_share`."""
    return Bounced(
        even.indirect,
        dr.lerp(even.openness, mirror.openness, share),
        dr.lerp(even.mirrored, mirror.radiance, share),
    )
