"""``tron_many_lights``: one frame under many environment maps at once.

    property       type      meaning
    lights         object    environment maps: tron.integrators.embed([map, ...])
    max_depth      integer   longest path in segments, as of Mitsuba's ``path`` (default: 6)
    hide_emitters  boolean   leave out the light that is seen directly (default: false)
    first_rays     integer   shadow rays at the surface that is seen (default: as many as lights)
    later_rays     integer   shadow rays at each surface that light came by (default: two fifths of those)

Channels ``light0.R``, ``light0.G`` and so on are linear radiance under each light, in expectation what
``path`` renders of the scene under that light alone; main channels are their mean. Emitters of the Mitsuba
scene are not seen.

Paths, hits and materials do not depend on the light, so all lights share them. At each hit shadow rays go
where any of the lights is bright (:class:`tron.integrators.stacked_lights.StackedLights`), and each that
arrives brings the radiance of all lights: what a ray costs is paid once. Together with the material's own
sample, which brings their radiance where it leaves the scene, they are weighted by the balance heuristic
(Veach 1997), one weight for all lights:

    K rays of density q and one of density p:   L f cos / (K q + p)   for each of the K + 1
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from tron.errors import TronError
from tron.integrators.stacked_lights import StackedLights
from tron.integrators.surfels import unwrap
from tron.shading.environment import EnvironmentMap

NAME = "tron_many_lights"
MAX_DEPTH = 6
LATER_SHARE = 0.4
"""Shadow rays at later hits over those at the first: with 20 lights 0.2 to 0.6 are as good."""


def many_lights_class() -> type:
    """The integrator for the active variant: Mitsuba's base classes differ between them."""

    class ManyLights(mi.SamplingIntegrator):
        def __init__(self, properties: mi.Properties) -> None:
            super().__init__(properties)
            carried = unwrap(properties, "lights", list, NAME)
            if not all(isinstance(light, EnvironmentMap) for light in carried):
                raise TronError(
                    f"property 'lights' of {NAME} holds no environment maps",
                    mend="give tron.integrators.embed([EnvironmentMap, ...])",
                )
            self.lights = StackedLights(carried)
            self.max_depth = properties.get("max_depth", MAX_DEPTH)
            self.hides = properties.get("hide_emitters", False)
            first = properties.get("first_rays", self.lights.count)
            rays = [first, properties.get("later_rays", math.ceil(LATER_SHARE * first))]
            if self.max_depth < 1 or min(rays) < 1:
                raise TronError(f"{NAME} has no path or no shadow ray", mend="give numbers of 1 or more")
            # Opaque: other numbers of rays and bounces are traced by the same kernel.
            self._depth = dr.opaque(mi.UInt32, self.max_depth)
            self._rays = [dr.opaque(mi.UInt32, number) for number in rays]

        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: mi.Bool | bool = True,
        ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float]]:
            """Mitsuba's contract: mean radiance along rays, whether they hit, radiance of each light."""
            del medium
            colors, hit = trace(
                scene, sampler, ray, self.lights, self._depth, self._rays, self.hides, mi.Bool(active)
            )
            mean = sum(colors[1:], colors[0]) / len(colors)
            return mean, hit if self.hides else mi.Bool(active), [part for color in colors for part in color]

        def aov_names(self) -> list[str]:
            return [f"light{k}.{part}" for k in range(self.lights.count) for part in "RGB"]

        def to_string(self) -> str:
            return f"{NAME}[lights={self.lights.count}, max_depth={self.max_depth}]"

    return ManyLights


@dr.syntax
def trace(
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    lights: StackedLights,
    max_depth: mi.UInt32,
    rays: list[mi.UInt32],
    hides: bool,
    active: Any,
) -> tuple[list[mi.Color3f], mi.Bool]:
    """Radiance of every light along camera rays, and where they hit.

    Args:
        scene: its shapes; emitters are not seen.
        sampler: of a wavefront as wide as ``ray``.
        ray: from a sensor.
        lights: what lights the scene.
        max_depth: longest path, segments.
        rays: shadow rays at the first hit and at later ones.
        hides: leave out light that is seen directly.
        active: lanes that are wanted.
    """
    context = mi.BSDFContext()
    si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True, active=active)
    hit = active & si.is_valid()
    if dr.hint(hides, mode="scalar"):
        total = [mi.Color3f(0) for _ in range(lights.count)]
    else:
        total = lights.background(ray.d, active & ~hit)
    throughput = mi.Color3f(1)
    depth = mi.UInt32(1)
    active = hit & (depth < max_depth)
    while active:
        bsdf = si.bsdf()
        count = dr.select(depth == 1, rays[0], rays[1])
        number = mi.Float(count)

        k = mi.UInt32(0)
        while k < count:
            along = (mi.Float(k) + sampler.next_1d()) / number
            light = lights.sample(along, sampler.next_2d(), active)
            value, pdf = bsdf.eval_pdf(context, si, si.to_local(light.direction), active)
            value *= throughput
            wanted = active & (dr.max(value) > 0)
            weight = dr.select(wanted, value / (number * light.density + pdf), 0)
            open_ = wanted & ~scene.ray_test(si.spawn_ray(light.direction), wanted)
            total = lights.add(total, light.index, weight, open_)
            k += 1

        drawn, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), active)
        throughput *= weight
        active &= dr.max(throughput) > 0
        onward = si.spawn_ray(si.to_world(drawn.wo))
        si = scene.ray_intersect(onward, mi.RayFlags.All, coherent=False, active=active)
        away = active & ~si.is_valid()
        texel = lights.seen(onward.d, sampler.next_1d(), away)
        delta = mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
        mis = dr.select(delta, 1, drawn.pdf / (drawn.pdf + number * texel.density))
        total = lights.add(total, texel.index, dr.select(away, throughput * mis, 0), away)
        depth += 1
        active &= si.is_valid() & (depth < max_depth)
    return total, hit
