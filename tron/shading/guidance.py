"""G-buffer + environment -> guidance: the buffers that the neural renderer is conditioned on.

    pbr         unshadowed split-sum shading
    irradiance  radiance of a white diffuse surface, shadows included: U times visibility
    shadowed    direct light, with shadows on the diffuse part
    indirect    irradiance / pi of light that bounced between surfels (:mod:`tron.shading.bounces.bounce`)
    lit         all light, as a path tracer would show it

:mod:`tron.shading.composition` has the formulas; U is the unshadowed irradiance / pi. The n-ray estimates of
shadowed and unshadowed irradiance share their rays, so visibility, their quotient, keeps the shadows without
the noise of the light; the noiseless U then restores the light (Heitz et al. 2018). From 16 rays visibility
is this ratio, below a regression without bias in shadow (:mod:`tron.shading.direct.visibility`). With 64 rays
under a sun the relative error falls from 0.13 to 0.04; irradiance over unshadowed is exactly 1 where nothing
blocks. :class:`tron.estimation.Estimation` selects the estimator, including the paper's plain mean.

Every buffer shows the environment behind the surfels: (1 - share) x shaded + share x radiance seen, with the
share of :mod:`tron.shading.composition`, exactly 0 behind opaque surfels. All buffers are linear; exposure
and AgX are applied when a buffer is displayed or loaded. Emission is added to pbr, shadowed and lit.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.cameras import Camera
from tron.color import Look, to_display
from tron.estimation import FINAL, MOST_RAYS, OCTAVES, Brdf, Estimation
from tron.io.images import encode_png, write_image
from tron.metering import incident_exposure
from tron.shading.bounces.bounce import BOUNCED_VALUES, SHOWN_RAYS, BouncedLight
from tron.shading.composition import Bounced, Response, evenly_bounced, over_background
from tron.shading.direct.irradiance import Occluder
from tron.shading.direct.visibility import Shadows, visibility
from tron.shading.lighting import Lighting
from tron.shading.reflections import Mirror, metal_reflections, metal_share, reflections, with_mirror

if TYPE_CHECKING:
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
        unshadowed: (H, W, 3) irradiance / pi without shadows.
        shadowed: (H, W, 3) radiance: shadowed diffuse plus split-sum specular.
        indirect: (H, W, 3) irradiance / pi of bounced light; 0 on surfels if none was baked.
        lit: (H, W, 3) radiance with bounced light; equal to ``shadowed`` if none was baked.
        mask: (H, W) opacity of the surfels in [0, 1].
        gbuffer: ``GBuffer.numpy()``, not one of the buffers; with sub-pixels, their means
            (:func:`tron.shading.guidance.averaged_surface`).
        lighting: the light, which sets the exposure of pictures.
    """

    pbr: np.ndarray
    irradiance: np.ndarray
    unshadowed: np.ndarray
    shadowed: np.ndarray
    indirect: np.ndarray
    lit: np.ndarray
    mask: np.ndarray
    gbuffer: dict[str, np.ndarray]
    lighting: Lighting | None = None
    BUFFERS: ClassVar[tuple[str, ...]]

    def __getitem__(self, name: str) -> np.ndarray:
        """One of :attr:`BUFFERS` as (H, W, C) float32: C is 1 for the mask, 3 for the others."""
        if name not in self.BUFFERS:
            raise KeyError(name)
        return np.atleast_3d(getattr(self, name))

    def exposure(self, look: Look = "photograph") -> float:
        """Factor on linear values before AgX that a photographer would choose; 1 for a frame without light.

        Raises:
            TronError: nothing is lit.
        """
        if self.lighting is None:
            return 1.0
        forward = self.gbuffer["direction"].mean((0, 1), dtype=np.float64)
        card = self.lighting.environment.unoccluded(-forward / np.linalg.norm(forward))
        return incident_exposure(self, card, look)

    def write(
        self,
        path: str | os.PathLike[str],
        name: str = "lit",
        exposure: float | None = None,
        look: Look = "photograph",
    ) -> None:
        """Write a buffer: a picture to .png or .jpg, linear values to .exr or .hdr.

        Args:
            path: the file; its suffix selects the format.
            name: one of :attr:`BUFFERS`. Pictures of light are exposed and go through AgX.
            exposure: factor before AgX; None: :meth:`exposure`.
            look: AgX look of pictures (:data:`tron.color.LOOKS`).

        Raises:
            TronError: nothing is lit, or the file cannot be written.
        """
        image = self[name]
        if Path(path).suffix.lower() in (".png", ".jpg", ".jpeg") and name != "mask":
            image = to_display(image, self.exposure(look) if exposure is None else exposure, look=look)
        write_image(path, image)

    def _repr_png_(self) -> bytes:
        """The picture of ``lit``, which a notebook shows in place of a frame."""
        return encode_png(to_display(self.lit, self.exposure(), look="photograph"))


Guidance.BUFFERS = tuple(
    field.name for field in fields(Guidance) if field.name not in ("gbuffer", "lighting")
)


@dataclass
class Arriving:
    """Results of the rays from surfaces, one lane per surface point.

    Attributes:
        visibility: share of the unshadowed irradiance that arrives, by channel.
        mirror: result of reflection rays; None without them.
        metals: result of metals' reflection rays, in previews (:mod:`tron.shading.reflections`); or None.
        behind: radiance behind the surfels (:class:`tron.relighting.ground.Ground`); None: the environment's.
    """

    visibility: mi.Color3f
    mirror: Mirror | None = None
    metals: Mirror | None = None
    behind: mi.Color3f | None = None

    def in_rows(self, gbuffer: GBuffer) -> Arriving:
        """The same with one lane per pixel, row by row, from the lanes of ``gbuffer``."""
        found = (self.visibility, self.mirror, self.metals, self.behind)
        return Arriving(*(None if value is None else gbuffer.in_rows(value) for value in found))


def render_guidance(
    tracer: ViewTracer,
    camera: Camera,
    lighting: Lighting,
    estimation: Estimation = FINAL,
    seed: int = 0,
    background: Sequence[float] | None = None,
    bounce: BouncedLight | None = None,
) -> Guidance:
    """Trace ``camera``'s view of the surfels and shade it under ``lighting``.

    Args:
        tracer: the scene.
        camera: the view.
        lighting: the prepared environment.
        estimation: how light is estimated.
        seed: root of the rays' random numbers.
        background: linear RGB radiance behind the surfels; None: the environment.
        bounce: ``lighting`` baked at each surfel (``BounceTransport.bake``). If None, or without bounces
            in ``estimation``, no light bounces.
    """
    gbuffer = trace_view(tracer, camera, estimation, bounce)
    arriving = arriving_light(tracer, gbuffer, lighting, estimation, seed, bounce)
    return shade(gbuffer, arriving, lighting, background, estimation)


def trace_view(
    tracer: ViewTracer, camera: Camera, estimation: Estimation = FINAL, bounce: BouncedLight | None = None
) -> GBuffer:
    """Trace the G-buffer for :func:`shade`, with the values of ``bounce`` and any sub-pixels."""
    return trace_views(tracer, camera, estimation, [bounce])[0]


def trace_views(
    tracer: ViewTracer, camera: Camera, estimation: Estimation, bounces: Sequence[BouncedLight | None]
) -> list[GBuffer]:
    """G-buffers of :func:`trace_view` for many lights, traced once; only values of ``bounces`` differ."""
    times = estimation.supersample
    values = [bounce.values(estimation.rays) if bounce and estimation.bounces else [] for bounce in bounces]
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
    """Light that reaches the pixels of :func:`trace_view`; arguments as in :func:`render_guidance`."""
    estimation = estimation.of_sub_pixel()
    if estimation.rays == 0 and len(gbuffer.values) > BOUNCED_VALUES:
        arriving = arrived(gbuffer)
    else:
        arriving = Arriving(visibility(tracer, gbuffer, lighting, estimation, seed))
    if bounce is not None and estimation.bounces and estimation.reflections:
        occluder = tracer.sided(estimation.two_sided)
        arriving.mirror = reflections(
            occluder, gbuffer, lighting, bounce, estimation.reflections, seed, estimation.brdf
        )
    elif bounce is not None and estimation.bounces and estimation.filtered:
        occluder = tracer.sided(estimation.two_sided)
        arriving.metals = metal_reflections(occluder, gbuffer, lighting, bounce, estimation, seed)
    return arriving


def arrived(surface: Surface) -> Arriving:
    """Light that reaches a ``surface`` with all values of a bake, read from them without any ray."""
    return Arriving(mi.Color3f(*surface.values[BOUNCED_VALUES:]))


def shade_surface(
    surface: Surface,
    arriving: Arriving,
    lighting: Lighting,
    background: Sequence[float] | None = None,
    brdf: Brdf = "conserving",
) -> dict[str, mi.Color3f]:
    """Shade the surfaces that rays see, given the light that reaches them.

    Bounced light is included if ``surface`` has the values of a bake (``BouncedLight.values``).
    ``background``: as in :func:`render_guidance`. Returns :class:`Guidance` colours by name, a lane per ray.
    """
    response = Response.of(surface, lighting.split_sum, brdf)
    irradiance = response.unshadowed * arriving.visibility
    bounced = bounced_light(surface, arriving, response)
    if background is None and arriving.behind is not None:
        behind = arriving.behind
    elif background is None:
        behind = lighting.light.radiance(surface.direction)
    else:
        behind = mi.Color3f(*(dr.opaque(mi.Float, float(channel)) for channel in background))

    buffers = {
        "pbr": response.open(),
        "irradiance": irradiance,
        "unshadowed": response.unshadowed,
        "shadowed": response.direct(irradiance),
        "indirect": mi.Color3f(0) if bounced is None else bounced.indirect,
        "lit": response.direct(irradiance) if bounced is None else response.lit(irradiance, bounced),
    }
    if surface.emission is not None:
        buffers |= {name: buffers[name] + surface.emission for name in ("pbr", "shadowed", "lit")}
    buffers = {name: over_background(color, behind, surface.opacity) for name, color in buffers.items()}
    dr.eval(buffers)
    return buffers


def bounced_light(surface: Surface, arriving: Arriving, response: Response) -> Bounced | None:
    """Bounced light of a surface with the values of a bake; None without them."""
    if not surface.values:
        return None
    indirect, openness = mi.Color3f(*surface.values[:3]), surface.values[BOUNCED_VALUES - 1]
    if arriving.mirror is None:
        even = evenly_bounced(indirect, openness, arriving.visibility, surface.roughness, response)
        return even if arriving.metals is None else with_mirror(even, arriving.metals, metal_share(surface))
    return Bounced(indirect, arriving.mirror.openness, arriving.mirror.radiance)


def shade(
    gbuffer: GBuffer,
    arriving: Arriving,
    lighting: Lighting,
    background: Sequence[float] | None = None,
    estimation: Estimation = FINAL,
) -> Guidance:
    """Guidance from a G-buffer of :func:`trace_view` and the light that reaches its pixels.

    Arguments as in :func:`render_guidance`.
    """
    colors = gbuffer.images(shade_surface(gbuffer, arriving, lighting, background, estimation.brdf))
    buffers = gbuffer.numpy()
    if estimation.supersample > 1:
        colors = {name: averaged(color, estimation.supersample) for name, color in colors.items()}
        buffers = averaged_surface(buffers, estimation.supersample)
    return Guidance(**colors, mask=buffers["opacity"], gbuffer=buffers, lighting=lighting)


def averaged(image: np.ndarray, times: int) -> np.ndarray:
    """(H times, W times, ...) -> (H, W, ...): means of ``times`` x ``times`` sub-pixels."""
    height, width = (side // times for side in image.shape[:2])
    return image.reshape(height, times, width, times, *image.shape[2:]).mean((1, 3))


def averaged_surface(gbuffer: dict[str, np.ndarray], times: int) -> dict[str, np.ndarray]:
    """Average a G-buffer of sub-pixels to pixels, each field by its own rule.

    Opacity and the premultiplied ``rgb`` are means. Base color, roughness, metallic, position and other
    values are opacity-weighted means, as in compositing along one ray, and 0 where opacity is 0. Normal and
    direction are normalised again. Depth is the opacity-weighted mean of the sub-pixels that have one.

    Args:
        gbuffer: ``GBuffer.numpy()``, (H times, W times, ...) each.
        times: sub-pixels along a pixel's side.
    """
    opacity = gbuffer["opacity"]
    weights = dict.fromkeys(gbuffer, opacity)
    weights["depth"] = opacity * (gbuffer["depth"] > 0)
    weights |= {name: np.ones_like(opacity) for name in ("opacity", "rgb", "direction")}
    means = {name: _mean(image, weights[name], times) for name, image in gbuffer.items()}
    for name in ("normal", "direction"):
        length = np.linalg.norm(means[name], axis=-1, keepdims=True)
        means[name] = means[name] / np.where(length > 0, length, 1)
    return means


def _mean(image: np.ndarray, weight: np.ndarray, times: int) -> np.ndarray:
    weight = weight.reshape(*weight.shape, *(1,) * (image.ndim - 2))
    total = averaged(weight, times)
    return averaged(image * weight, times) / np.where(total > 0, total, 1)


# Guidance under a light is sampled once per pixel, because shadow rays are expensive; camera rays are cheap.
# These maps are means over 2 x 2 sub-pixels, from which a network can tell texture from noise and how much of
# a pixel an edge covers.

SUB_PIXELS = 2
"""Sub-pixels along a pixel's side."""


def surface_maps(
    tracer: ViewTracer, camera: Camera, estimations: Sequence[Estimation]
) -> list[dict[str, np.ndarray]]:
    """The members of one view that do not depend on the light, one set per estimation.

    Each is (H, W, 3) float32 in [0, 1], a mean over sub-pixels:

        albedo      linear base color, by opacity: 0 where no surfels are
        surface     |n . v| of unit normal and direction to the camera, roughness, metallic; by opacity
        sampling    a third if filtered and two if of sub-pixels; log2 of the shadow rays a pixel over
                    MOST_RAYS of tron.estimation; log2 of the pixel's footprint, distance / fx, over the
                    scene's surfel spacing, OCTAVES of tron.estimation as 0 to 1, and 1 where no surfels are

    ``sampling`` tells a network how strong the light's noise and the surfels' blur are.
    """
    fine = camera.resized(SUB_PIXELS * camera.width, SUB_PIXELS * camera.height)
    seen = tracer.gbuffer(fine).numpy()
    facing = np.abs((seen["normal"] * seen["direction"]).sum(-1))
    maps = {
        "albedo": seen["base_color"],
        "surface": np.stack([facing, seen["roughness"], seen["metallic"]], axis=-1),
    }
    opacity = seen["opacity"][..., None]
    maps = {name: averaged(np.clip(image, 0, 1) * opacity, SUB_PIXELS) for name, image in maps.items()}
    distance = np.linalg.norm(seen["position"] - camera.position, axis=-1, keepdims=True)
    footprint = np.maximum(distance, 1e-30) / (camera.fx * tracer.scene.spacing)
    low, high = OCTAVES
    octaves = np.clip((np.log2(footprint) - low) / (high - low), 0, 1)
    octaves = averaged(opacity * octaves + 1 - opacity, SUB_PIXELS)
    return [maps | {"sampling": _sampling(estimation, octaves)} for estimation in estimations]


def _sampling(estimation: Estimation, octaves: np.ndarray) -> np.ndarray:
    """``sampling`` from its last channel, (H, W, 1)."""
    kind = (estimation.filtered + 2 * (estimation.supersample > 1)) / 3
    rays = min(np.log2(estimation.rays or SHOWN_RAYS) / MOST_RAYS, 1)
    told = np.broadcast_to([kind, rays], (*octaves.shape[:2], 2))
    return np.concatenate([told, octaves], axis=-1).astype(np.float32)
