"""``tron_guidance``: what the surfels look like under an environment, along each ray of a sensor.

    property            type      meaning
    filename, surfels             as of tron_gbuffer
    environment         string    the light: a lat-long .hdr or .exr in TRON's orientation (up is +z)
                        object    or from memory: tron.integrators.embed(environment_map)
                                  without either, the Mitsuba scene's own environment emitter
    buffer              string    pbr (default), irradiance, unshadowed, shadowed, indirect or lit
    shadow_rays         integer   for each camera ray, even (default: 64); of many camera rays per pixel, each
                                  may have fewer: 2 lighten shadows by a hundredth or two, 8 by nothing
    estimator           string    ratio (default) or plain: see tron.estimation
    two_sided           boolean   back faces block shadow rays beyond two spacings (default: true)
    bounces             integer   times that light bounces between surfels (default: 4; 0: never)
    reflections         integer   for each camera ray, rays that find what glossy surfaces mirror (default: 0)
    diffuse             string    material: principled (default), as Mitsuba has it, or lambert
    cubemap_resolution  integer   of the prefiltered environment

Buffers are those of :mod:`tron.shading.guidance`: linear, in front of the environment, which is not seen
through opaque surfels; alpha is opacity. Those that are not the main channels follow as ``irradiance.R`` and
so on, then ``opacity.Y``.

What surfels see of one another is traced once, and again when they have moved; light is baked on them once,
and again when it has changed.

Gradients reach the surfels through what camera rays see, as shading has it, and the materials of all of them
through the light that bounces; what shadow and reflection rays find is a constant, and so is direct light.
"""

from __future__ import annotations

from typing import Any, get_args

import drjit as dr
import mitsuba as mi

from tron.errors import TronError
from tron.estimation import FINAL, Diffuse, Estimation, Estimator
from tron.integrators.bounces import Bounces
from tron.integrators.environment import environment_of, light_state
from tron.integrators.plugin import Shown
from tron.integrators.surfels import Surfels, unwrap
from tron.shading.environment import EnvironmentMap
from tron.shading.guidance import Guidance, Lighting, arriving_light, shade_surface
from tron.shading.split_sum import CUBEMAP_RESOLUTION
from tron.tracing import GBuffer

BUFFERS = tuple(name for name in Guidance.BUFFERS if name != "mask")


class GuidanceAppearance:
    """Shows surfels under a light."""

    def __init__(self, properties: mi.Properties) -> None:
        self.surfels = Surfels(properties, "tron_guidance")
        self.buffer = properties.get("buffer", BUFFERS[0])
        if self.buffer not in BUFFERS:
            mend = f"choose one of {', '.join(BUFFERS)}"
            raise TronError(f"tron_guidance has no buffer {self.buffer!r}", mend=mend)
        self.others = [name for name in BUFFERS if name != self.buffer]
        self.channels = [f"{name}.{part}" for name in self.others for part in "RGB"] + ["opacity.Y"]
        self.estimation = _estimation(properties)
        self._resolution = int(properties.get("cubemap_resolution", CUBEMAP_RESOLUTION))
        self._environment = _given_environment(properties)
        self._prepared: tuple[Any, Lighting] | None = None
        self._bounces = Bounces(self.surfels, self.estimation)

    def show(self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool, width: int, seed: int) -> Shown:
        """See :class:`tron.integrators.plugin.Appearance`."""
        lighting = self._lighting(scene)
        bounce = self._bounces.bake(lighting) if self.estimation.bounces else None
        values = () if bounce is None else bounce.values()
        surface = self.surfels.trace(ray.o, ray.d, active, values)
        with dr.suspend_grad():
            rays = GBuffer.of_rows(dr.detach(surface), width, dr.width(surface.opacity) // width)
            dr.eval(rays)
            arriving = arriving_light(self.surfels.tracer, rays, lighting, self.estimation, seed, bounce)
            arriving = arriving.in_rows(rays)
        shaded = shade_surface(surface, arriving, lighting, diffuse=self.estimation.diffuse)
        extra = [part for name in self.others for part in shaded[name]]
        return Shown(shaded[self.buffer], surface.opacity, [*extra, surface.opacity])

    def _lighting(self, scene: mi.Scene) -> Lighting:
        """Prepared once, and again when the scene's light has changed."""
        state = None if self._environment else light_state(scene)
        if self._prepared is None or self._prepared[0] != state:
            environment = self._environment or environment_of(scene)
            self._prepared = state, Lighting(environment, self._resolution)
        return self._prepared[1]


CHOICES = {"estimator": Estimator, "diffuse": Diffuse}
NUMBERS = {"bounces": (0, 16), "reflections": (0, 1024)}
"""Least and greatest."""


def _estimation(properties: mi.Properties) -> Estimation:
    rays = int(properties.get("shadow_rays", FINAL.rays))
    if rays < 2 or rays % 2:
        raise TronError(f"shadow_rays is {rays}", mend="give an even number of shadow rays, 2 or more")
    given: dict[str, Any] = {"rays": rays, "two_sided": bool(properties.get("two_sided", FINAL.two_sided))}
    for name, choices in CHOICES.items():
        given[name] = properties.get(name, getattr(FINAL, name))
        if given[name] not in get_args(choices):
            mend = f"choose {' or '.join(get_args(choices))}"
            raise TronError(f"tron_guidance has no {name} {given[name]!r}", mend=mend)
    for name, (least, greatest) in NUMBERS.items():
        given[name] = int(properties.get(name, getattr(FINAL, name)))
        if not least <= given[name] <= greatest:
            raise TronError(f"{name} is {given[name]}", mend=f"give {least} to {greatest}")
    return Estimation(**given)


def _given_environment(properties: mi.Properties) -> EnvironmentMap | None:
    if "environment" not in properties:
        return None
    if isinstance(properties["environment"], str):
        return EnvironmentMap.load(properties["environment"])
    return unwrap(properties, "environment", EnvironmentMap, "tron_guidance")
