"""``tron_guidance``: surfels shaded under an environment, along each ray of a sensor.

    property            type      meaning
    filename, surfels             as in tron_gbuffer
    environment         string    the light: a lat-long .hdr or .exr in TRON's orientation (up is +z)
                        object    or from memory: tron.integrators.embed(environment_map)
                                  if absent, the Mitsuba scene's own environment emitter
    buffer              string    pbr (default), irradiance, unshadowed, shadowed, indirect or lit
    shadow_rays         integer   per camera ray, even (default: 64); with many camera rays per pixel fewer
                                  suffice: 2 lighten shadows by 1 to 2 %, 8 not at all
    estimator           string    ratio (default) or plain: see tron.estimation
    two_sided           boolean   back faces block shadow rays beyond two spacings (default: true)
    bounces             integer   bounces of light between surfels (default: 4; 0: none)
    reflections         integer   reflection rays of glossy surfaces per camera ray (default: 0)
    brdf                string    material: conserving (default), which loses no light, or lambert
    cubemap_resolution  integer   of the prefiltered environment

Buffers are those of :mod:`tron.shading.guidance`: linear, in front of the environment, which is not seen
through opaque surfels; alpha is opacity. The other buffers follow the main channels as ``irradiance.R`` and
so on, then ``opacity.Y``.

Visibility between surfels is traced once, and again when they have moved; light is baked on them once, and
again when it has changed.

Gradients reach the surfels that camera rays see through shading, and the materials of all surfels through
bounced light. The results of shadow and reflection rays are constants, and so is direct light.
"""

from __future__ import annotations

import math
from typing import Any, get_args

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.errors import TronError
from tron.estimation import FINAL, Brdf, Estimation, Estimator
from tron.gaussians.fields import MATERIALS, PARAMETERS
from tron.integrators.plugin import Held, Shown, Surfels, unwrap
from tron.shading.bounces.bounce import BouncedLight, BounceTransport, at_surfels
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Guidance, arriving_light, shade_surface
from tron.shading.lighting import CUBEMAP_RESOLUTION, Lighting
from tron.tracing import GBuffer

BUFFERS = tuple(name for name in Guidance.BUFFERS if name != "mask")
CHOICES = {"estimator": Estimator, "brdf": Brdf}
NUMBERS = {"bounces": (0, 16), "reflections": (0, 1024)}
"""Least and greatest allowed values."""
GEOMETRY = tuple(name for name in PARAMETERS if name not in (*MATERIALS, "sh"))
SAMPLED_HEIGHT = 512
"""Rows of the map sampled from an emitter whose texels are not read directly."""
OVERSAMPLING = 3
"""Rows sampled for each row of such a map."""


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
        shaded = shade_surface(surface, arriving, lighting, brdf=self.estimation.brdf)
        extra = [part for name in self.others for part in shaded[name]]
        return Shown(shaded[self.buffer], surface.opacity, [*extra, surface.opacity])

    def _lighting(self, scene: mi.Scene) -> Lighting:
        """The prepared light; it is prepared again when the scene's light has changed."""
        state = None if self._environment else light_state(scene)
        if self._prepared is None or self._prepared[0] != state:
            environment = self._environment or environment_of(scene)
            self._prepared = state, Lighting(environment, self._resolution)
        return self._prepared[1]


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


class Bounces:
    """Bakes of a plugin's surfels: transport is kept until they move, direct light until they or it change.

    If gradients are wanted, the bounces are gathered again at each render, attached to the materials: light
    reflected by a surfel carries the gradient of its base color.

    Args:
        surfels: the plugin's.
        estimation: of its frames.
    """

    def __init__(self, surfels: Surfels, estimation: Estimation) -> None:
        self.surfels, self.estimation = surfels, estimation
        self._transport: tuple[Any, BounceTransport] | None = None
        self._direct: tuple[Any, list[mi.Color3f]] | None = None

    def bake(self, lighting: Lighting) -> BouncedLight:
        """The light of ``lighting`` at each surfel, attached to materials whose gradients are wanted.

        Its rays use seed 0, regardless of the sensor's seed.
        """
        geometry = self.surfels.state(*GEOMETRY)
        with dr.suspend_grad():
            if self._transport is None or self._transport[0] != geometry:
                self._transport = (
                    geometry,
                    BounceTransport.trace(self.surfels.tracer.sided(self.estimation.two_sided)),
                )
                self._direct = None
            transport = self._transport[1]
            if self._direct is None or self._direct[0] is not lighting:
                self._direct = lighting, transport.direct_of_faces(lighting, at_surfels(self.estimation))
        return transport.bounced(self._direct[1], self.estimation)


def environment_of(scene: mi.Scene) -> EnvironmentMap:
    """The current environment of ``scene``.

    Raises:
        TronError: the scene has no environment emitter.
    """
    emitter = scene.environment()
    if emitter is None:
        raise TronError(
            "the scene has no environment to light the surfels",
            mend="add an emitter such as `envmap` or `constant` to it, or give the integrator `environment`",
        )
    if emitter.class_name() != "EnvironmentMapEmitter":
        return _sampled(emitter)
    parameters: Any = mi.traverse(emitter)
    image = np.array(parameters["data"])[:, 1:-1, :3]  # Mitsuba pads a column on either side
    rotation = _turn_about_z(np.array(parameters["to_world"].matrix)[..., 0])
    if rotation is None or image.shape[1] != 2 * image.shape[0]:
        return _sampled(emitter)
    return EnvironmentMap(image * float(parameters["scale"][0]), rotation)


def light_state(scene: mi.Scene) -> list[Any]:
    """A value that is equal for equal states of the scene's environment."""
    emitter = scene.environment()
    if emitter is None:
        return []
    return [emitter.ptr, *(Held(value) for _, value in mi.traverse(emitter))]


def _turn_about_z(to_world: np.ndarray) -> float | None:
    """Rotation of an upright map about +z in degrees; None if the map is not upright."""
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # rotate([1, 0, 0], 90)
    turn = to_world[:3, :3] @ upright.T
    angle = math.atan2(turn[1, 0], turn[0, 0])
    cos, sin = math.cos(angle), math.sin(angle)
    if np.abs(turn - [[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]).max() > 1e-5:
        return None
    return math.degrees(angle)


def _sampled(emitter: mi.Emitter) -> EnvironmentMap:
    """Sample the emitter's radiance into a map; rows stand on the poles, columns on half texels."""
    rows = OVERSAMPLING * SAMPLED_HEIGHT
    texel = dr.arange(mi.UInt32, 2 * rows * rows)
    polar = mi.Float(texel // (2 * rows)) * (math.pi / (rows - 1))
    across, along = dr.sincos((mi.Float(texel % (2 * rows)) + 0.5) * (math.pi / rows))
    sin, cos = dr.sincos(dr.clip(polar, 1e-4, math.pi - 1e-4))  # at a pole the azimuth is undefined
    si = dr.zeros(mi.SurfaceInteraction3f, 2 * rows * rows)
    si.wi = -mi.Vector3f(sin * across, sin * along, cos)
    radiance = mi.Color3f(emitter.eval(si)) + dr.zeros(mi.Color3f, 2 * rows * rows)
    return EnvironmentMap(np.array(radiance).T.reshape(rows, 2 * rows, 3)).resized(SAMPLED_HEIGHT)
