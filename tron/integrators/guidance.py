"""``tron_guidance``: what the surfels look like under an environment, along each ray of a sensor.

    property            type      meaning
    filename, surfels             as of tron_gbuffer
    environment         string    the light: a lat-long .hdr or .exr in TRON's orientation (up is +z)
                        object    or from memory: tron.integrators.embed(environment_map)
                                  without either, the Mitsuba scene's own environment emitter
    buffer              string    main channels: pbr (default), irradiance, unshadowed or shadowed
    shadow_rays         integer   for each camera ray, even (default: 64); of many camera rays per pixel, each
                                  may have fewer: 2 lighten shadows by a hundredth or two, 8 by nothing
    estimator           string    ratio (default) or plain: see tron.estimation
    two_sided           boolean   back faces block shadow rays beyond two spacings (default: true)
    cubemap_resolution  integer   of the prefiltered environment

Buffers are those of :mod:`tron.shading.guidance`: linear, in front of the environment, which is not seen
through opaque surfels; alpha is opacity. Those that are not the main channels follow as ``irradiance.R`` and
so on, then ``opacity.Y``.

Gradients reach the surfels through what camera rays see, as shading has it; what shadow rays find is a
constant, and so is the light.
"""

from __future__ import annotations

from typing import Any, get_args

import drjit as dr
import mitsuba as mi

from tron.errors import TronError
from tron.estimation import FINAL, Estimation, Estimator
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

    def show(self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool, width: int, seed: int) -> Shown:
        """See :class:`tron.integrators.plugin.Appearance`."""
        lighting = self._lighting(scene)
        surface = self.surfels.trace(ray.o, ray.d, active)
        with dr.suspend_grad():
            rays = GBuffer.of_rows(dr.detach(surface), width, dr.width(surface.opacity) // width)
            dr.eval(rays)
            arriving = arriving_light(self.surfels.tracer, rays, lighting, self.estimation, seed)
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


def _estimation(properties: mi.Properties) -> Estimation:
    rays = int(properties.get("shadow_rays", FINAL.rays))
    if rays < 2 or rays % 2:
        raise TronError(f"shadow_rays is {rays}", mend="give an even number of shadow rays, 2 or more")
    estimator = properties.get("estimator", FINAL.estimator)
    if estimator not in get_args(Estimator):
        mend = f"choose {' or '.join(get_args(Estimator))}"
        raise TronError(f"tron_guidance has no estimator {estimator!r}", mend=mend)
    two_sided = bool(properties.get("two_sided", FINAL.two_sided))
    return Estimation(rays=rays, estimator=estimator, two_sided=two_sided)


def _given_environment(properties: mi.Properties) -> EnvironmentMap | None:
    if "environment" not in properties:
        return None
    if isinstance(properties["environment"], str):
        return EnvironmentMap.load(properties["environment"])
    return unwrap(properties, "environment", EnvironmentMap, "tron_guidance")
