"""G-buffer + environment -> guidance: the buffers that the neural renderer is conditioned on.

    pbr         unshadowed split-sum
    irradiance  what a white diffuse surface sends out, shadows included: U times the share that arrives
    shadowed    direct light, with shadows on the diffuse part
    indirect    irradiance / pi by light that bounced between the surfels (:mod:`tron.shading.bounce`)
    lit         all light: what a path tracer shows

The formulas are those of :mod:`tron.shading.composition`; U is the unshadowed irradiance / pi. The n-ray
estimates of shadowed and unshadowed irradiance share their rays, so the share that arrives keeps the shadows
and sheds the noise of the light, and U, which has none, puts the light back (Heitz et al. 2018). From 16 rays
it is their ratio, below a regression that is not biased in shadow (:mod:`tron.shading.few_rays`). At 64 rays
under a sun this takes the relative error from 0.13 to 0.04; irradiance over unshadowed is exactly 1 where
nothing is in the way. :class:`tron.estimation.Estimation` chooses, also the paper's plain mean.

Every buffer shows the environment where surfels are absent: (1 - share) x shaded + share x radiance seen,
with the share of :mod:`tron.shading.background`, exactly 0 behind opaque surfels. All of it is linear;
exposure and AgX are applied when a buffer is looked at or loaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, ClassVar, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.estimation import FINAL, Diffuse, Estimation
from tron.shading.background import over_background
from tron.shading.bounce import BouncedLight
from tron.shading.composition import Bounced, Response, evenly_bounced
from tron.shading.irradiance import Occluder
from tron.shading.lighting import Lighting
from tron.shading.reflections import Mirror, reflections
from tron.shading.supersampling import averaged, averaged_surface
from tron.shading.visibility import Shadows, visibility

if TYPE_CHECKING:
    from tron.cameras import Camera
    from tron.tracing import GBuffer, Surface


class ViewTracer(Occluder, Shadows, Protocol):
    """Camera rays and shadow rays: :class:`tron.tracing.SurfelTracer`, or a closed form in a test."""

    def gbuffer(self, camera: Camera, values: Sequence[mi.Float] = ()) -> GBuffer: ...


@dataclass
class Guidance:
    """Buffers of one frame, NumPy float32, linear, in front of the environment; also by name.

    A new buffer is a field here and a line in :func:`shade_surface`.

    Attributes:
        pbr: (H, W, 3) unshadowed split-sum radiance.
        irradiance: (H, W, 3) shadowed irradiance / pi.
        unshadowed: (H, W, 3) the same with nothing in the way.
        shadowed: (H, W, 3) radiance: shadowed diffuse plus split-sum specular.
        indirect: (H, W, 3) irradiance / pi by bounced light; 0 on surfels where none was baked.
        lit: (H, W, 3) radiance with bounced light; ``shadowed`` where none was baked.
        mask: (H, W) opacity of the surfels in [0, 1].
        gbuffer: ``GBuffer.numpy()``, which is no buffer of its own; of sub-pixels the means
            (:func:`tron.shading.supersampling.averaged_surface`).
    """

    pbr: np.ndarray
    irradiance: np.ndarray
    unshadowed: np.ndarray
    shadowed: np.ndarray
    indirect: np.ndarray
    lit: np.ndarray
    mask: np.ndarray
    gbuffer: dict[str, np.ndarray]
    BUFFERS: ClassVar[tuple[str, ...]]

    def __getitem__(self, name: str) -> np.ndarray:
        """(H, W, C) float32 of one of :attr:`BUFFERS`: C is 1 for the mask, 3 for the others."""
        if name not in self.BUFFERS:
            raise KeyError(name)
        return np.atleast_3d(getattr(self, name))


Guidance.BUFFERS = tuple(field.name for field in fields(Guidance) if field.name != "gbuffer")


@dataclass
class Arriving:
    """Findings of rays from surfaces, one lane each.

    Attributes:
        visibility: share of the unshadowed irradiance that arrives, by channel.
        mirror: by reflection rays; None without.
    """

    visibility: mi.Color3f
    mirror: Mirror | None = None

    def in_rows(self, gbuffer: GBuffer) -> Arriving:
        """Of pixels row by row, where lanes are those of ``gbuffer``."""
        mirror = None if self.mirror is None else gbuffer.in_rows(self.mirror)
        return Arriving(gbuffer.in_rows(self.visibility), mirror)


def render_guidance(
    tracer: ViewTracer,
    camera: Camera,
    lighting: Lighting,
    estimation: Estimation = FINAL,
    seed: int = 0,
    background: Sequence[float] | None = None,
    bounce: BouncedLight | None = None,
    gbuffer: GBuffer | None = None,
) -> Guidance:
    """Trace ``camera``'s view of the surfels and shade it under ``lighting``.

    Args:
        tracer: the scene.
        camera: the view.
        lighting: the prepared environment.
        estimation: of the light.
        seed: root of the rays' random numbers.
        background: linear RGB radiance behind the surfels; None: the environment.
        bounce: what ``lighting`` is at each surfel (``BounceTransport.bake``); None, or with no bounces in
            ``estimation``: no light bounces.
        gbuffer: the view where it is traced already, of :func:`trace_views`.
    """
    if gbuffer is None:
        gbuffer = trace_view(tracer, camera, estimation, bounce)
    arriving = arriving_light(tracer, gbuffer, lighting, estimation, seed, bounce)
    return shade(gbuffer, arriving, lighting, background, estimation)


def trace_view(
    tracer: ViewTracer, camera: Camera, estimation: Estimation = FINAL, bounce: BouncedLight | None = None
) -> GBuffer:
    """The G-buffer that :func:`shade` takes: of sub-pixels, if so, and with the values of ``bounce``."""
    return trace_views(tracer, camera, estimation, [bounce])[0]


def trace_views(
    tracer: ViewTracer, camera: Camera, estimation: Estimation, bounces: Sequence[BouncedLight | None]
) -> list[GBuffer]:
    """:func:`trace_view` under many lights, traced once: they differ in the values of their ``bounces``."""
    times = estimation.supersample
    values = [bounce.values() if bounce and estimation.bounces else [] for bounce in bounces]
    view = camera if times == 1 else camera.resized(times * camera.width, times * camera.height)
    every = [value for own in values for value in own]
    gbuffer = tracer.gbuffer(view, every) if every else tracer.gbuffer(view)
    shares = iter(gbuffer.values)
    return [replace(gbuffer, values=[next(shares) for _ in own]) for own in values]


def arriving_light(
    tracer: ViewTracer,
    gbuffer: GBuffer,
    lighting: Lighting,
    estimation: Estimation,
    seed: int,
    bounce: BouncedLight | None = None,
) -> Arriving:
    """Light that reaches the pixels of :func:`trace_view`; arguments as of :func:`render_guidance`."""
    estimation = estimation.of_sub_pixel()
    arriving = Arriving(visibility(tracer, gbuffer, lighting, estimation, seed))
    if bounce is not None and estimation.bounces and estimation.reflections:
        occluder = tracer.sided(estimation.two_sided)
        arriving.mirror = reflections(
            occluder, gbuffer, lighting, bounce, estimation.reflections, seed, estimation.diffuse
        )
    return arriving


def shade_surface(
    surface: Surface,
    arriving: Arriving,
    lighting: Lighting,
    background: Sequence[float] | None = None,
    diffuse: Diffuse = "principled",
) -> dict[str, mi.Color3f]:
    """Shade what rays see, given the light that reaches each of them.

    Light bounces where ``surface`` has the values of a bake (``BouncedLight.values``). ``background`` as of
    :func:`render_guidance`. Returns the colours of :class:`Guidance` by name, on the device, one lane a ray.
    """
    response = Response.of(surface, lighting.split_sum, diffuse)
    irradiance = response.unshadowed * arriving.visibility
    bounced = _bounced(surface, arriving)
    if background is None:
        behind = lighting.light.radiance(surface.direction)
    else:
        behind = mi.Color3f(*(dr.opaque(mi.Float, float(channel)) for channel in background))

    buffers = {
        "pbr": response.direct(response.unshadowed),
        "irradiance": irradiance,
        "unshadowed": response.unshadowed,
        "shadowed": response.direct(irradiance),
        "indirect": mi.Color3f(0) if bounced is None else bounced.indirect,
        "lit": response.direct(irradiance) if bounced is None else response.lit(irradiance, bounced),
    }
    buffers = {name: over_background(color, behind, surface.opacity) for name, color in buffers.items()}
    dr.eval(buffers)
    return buffers


def _bounced(surface: Surface, arriving: Arriving) -> Bounced | None:
    if not surface.values:
        return None
    indirect, openness = mi.Color3f(*surface.values[:3]), surface.values[3]
    if arriving.mirror is None:
        return evenly_bounced(indirect, openness, arriving.visibility, surface.roughness)
    return Bounced(indirect, arriving.mirror.openness, arriving.mirror.radiance)


def shade(
    gbuffer: GBuffer,
    arriving: Arriving,
    lighting: Lighting,
    background: Sequence[float] | None = None,
    estimation: Estimation = FINAL,
) -> Guidance:
    """Guidance from a G-buffer of :func:`trace_view` and the light that reaches its pixels.

    Arguments as of :func:`render_guidance`.
    """
    colors = gbuffer.images(shade_surface(gbuffer, arriving, lighting, background, estimation.diffuse))
    buffers = gbuffer.numpy()
    if estimation.supersample > 1:
        colors = {name: averaged(color, estimation.supersample) for name, color in colors.items()}
        buffers = averaged_surface(buffers, estimation.supersample)
    return Guidance(**colors, mask=buffers["opacity"], gbuffer=buffers)
