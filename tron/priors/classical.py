"""Intrinsic images without weights: photos and the reconstructed geometry, taken apart into color and light.

A diffuse surface under grey light shows I = base_color x irradiance (the latter over pi). The log of
irradiance is the sum of light by direction, one for all views (:mod:`tron.priors.shading_fit`), and of what
differs from place to place, mostly shadows (:mod:`tron.priors.retinex`). What remains is base color, and its
scale is set by a convention: few surfaces reflect more than 80%.

Assumed, and wrong where it is not so: diffuse surfaces, grey light (the white balance of the photo), sRGB
photos, one exposure for all views. Highlights and metals end in base color; roughness and metallic are not
estimated but set.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np
import pydantic
from pydantic import Field

from tron.captures import Capture, View
from tron.captures.view import Pixels
from tron.color import luminance
from tron.errors import TronError
from tron.priors.linear_light import ToneCurve, linear_light
from tron.priors.map_geometry import resized, world_normals
from tron.priors.prior import CONFIG, GBuffers, Maps, Request, Track
from tron.priors.retinex import residual_shading
from tron.priors.shading_fit import Shading, chromaticity, fit_shading
from tron.priors.sky import capture_radius, sky_mask
from tron.seeds import generator

_OPAQUE = 0.5
_FLOOR = 1e-3  # linear; below it, 8 bits hold neither luminance nor colour
_LIMIT = 2.0  # log units: no shadow is deeper for its colour, and no highlight brighter
_PERCENTILE = 95

Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]


@pydantic.dataclasses.dataclass(frozen=True, config=CONFIG)
class Classical:
    """The default prior. Everything but the constants waits for the geometry.

    Attributes:
        roughness: given everywhere.
        metallic: given everywhere.
        tone_curve: how display images are decoded: "srgb" for photos, "agx" for path-traced pictures.
        brightest: base color of the 95th percentile of all surface points, largest channel.
        groups: chromaticities that are told apart when light and color are.
        edge: log difference of luminance from which on a change is of color, not of light.
        chroma_edge: log difference of chromaticity, likewise.
        grey: log chromaticity below which a colour says nothing of the material, so that its brightness
            is believed.
        screening: how much a colour seen elsewhere counts against what neighbouring pixels say.
        longest_side: shadows are found on images of at most so many pixels along their longer side.
        samples: surface points of all views that the light is fitted to.
        sky_distance: multiples of the cameras' median distance to their centre, beyond which is sky.
        seed: root of the samples and the clustering.

    Raises:
        ValidationError: a number outside its range.
    """

    roughness: Share = 0.6
    metallic: Share = 0.0
    tone_curve: ToneCurve = "srgb"
    brightest: Positive = 0.8
    groups: Count = 24
    edge: Positive = 0.3
    chroma_edge: Positive = 0.2
    grey: Positive = 0.15
    screening: Positive = 0.1
    longest_side: Count = 256
    samples: Count = 20_000
    sky_distance: Positive = 10.0
    seed: int = 0

    @property
    def needs_geometry(self) -> frozenset[str]:
        """All but the constants."""
        return frozenset({"normal", "base_color", "irradiance", "sky_mask"})

    def fields(self, capture: Capture) -> Mapping[str, str]:  # noqa: ARG002 (the protocol's)
        """Everything, of any capture."""
        split = f"harmonic shading and retinex, {self.tone_curve} decoded, grey light"
        return {
            "normal": "the reconstructed geometry's",
            "base_color": f"{split}, scaled so that the {_PERCENTILE}th percentile is {self.brightest:g}",
            "roughness": f"constant {self.roughness:g}",
            "metallic": f"constant {self.metallic:g}",
            "irradiance": split,
            "sky_mask": "opacity, position and colour",
        }

    def prepare(self, request: Request) -> Maps:
        """Fit the light that all views share, if base color or irradiance are wanted.

        Raises:
            TronError: no training view shows a surface.
        """
        capture, fields, gbuffers = request.capture, request.fields, request.gbuffers
        splitter = None
        if gbuffers is not None and {"base_color", "irradiance"} & fields:
            splitter = self._splitter(capture, gbuffers, request.track)
        reach = self.sky_distance * capture_radius(capture)

        def maps(view: View) -> Mapping[str, Pixels]:
            size = (view.camera.height, view.camera.width)
            found: dict[str, Pixels] = {
                "roughness": partial(np.full, size, np.float32(self.roughness)),
                "metallic": partial(np.full, size, np.float32(self.metallic)),
            }
            if gbuffers is not None:
                geometry = gbuffers(view)
                light = linear_light(view, capture.exposure, self.tone_curve)
                surface = geometry["opacity"] > _OPAQUE
                normal = world_normals(geometry["normal"], view.camera, "world") * surface[..., None]
                found["normal"] = normal
                found["sky_mask"] = sky_mask(view, light, geometry, capture.up, reach)
                if splitter is not None:
                    found["base_color"], found["irradiance"] = splitter.split(light, normal)
            return {field: pixels for field, pixels in found.items() if field in fields}

        return maps

    def _splitter(self, capture: Capture, gbuffers: GBuffers, track: Track) -> _Splitter:
        light, normals = self._points(capture, gbuffers, track(capture.train_views, "light by direction"))
        log_luminance, chroma = np.log(luminance(light)), chromaticity(light)
        shading = fit_shading(chroma, normals, log_luminance, self.groups, self.seed)
        known = shading.log(normals)
        known = known + self._guess(shading, log_luminance - known, chroma)
        reflected = (light / np.exp(known)[:, None]).max(axis=1)
        scale = self.brightest / float(np.percentile(reflected, _PERCENTILE))
        return _Splitter(self, shading, scale, capture.exposure)

    def _points(
        self, capture: Capture, gbuffers: GBuffers, views: Iterable[View]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Linear light and normals, (N, 3) float64 each, of random surface points of all training views."""
        per_view = -(-self.samples // len(capture.train_views))
        light, normals = [], []
        for view in views:
            geometry = gbuffers(view)
            normal = world_normals(geometry["normal"], view.camera, "world")
            counts = (geometry["opacity"] > _OPAQUE) & normal.any(axis=-1)
            if view.has("mask"):
                counts &= view.read("mask") > _OPAQUE
            counts &= view.believed()
            chosen = np.flatnonzero(counts)
            if len(chosen) > per_view:
                draw = generator(self.seed, "prior", "classical", "points", view.name)
                chosen = np.sort(draw.choice(chosen, per_view, replace=False))
            image = linear_light(view, capture.exposure, self.tone_curve)
            light.append(np.maximum(image.reshape(-1, 3)[chosen], _FLOOR))
            normals.append(normal.reshape(-1, 3)[chosen])
        if not any(len(part) for part in light):
            raise TronError(
                "no training view shows a surface of the scene",
                mend="check that cameras and scene share one world, and that masks do not hide everything",
            )
        return np.concatenate(light).astype(np.float64), np.concatenate(normals).astype(np.float64)

    def _guess(self, shading: Shading, log_luminance: np.ndarray, chroma: np.ndarray) -> np.ndarray:
        """Log shading of points by their colour alone: how much darker they are than their like.

        Greys are alike whatever they are made of, so the guess fades to zero towards grey.
        """
        darker = (log_luminance - shading.log_reflectance(chroma)).clip(-_LIMIT, _LIMIT)
        return darker * (1 - np.exp(-(chroma**2).sum(-1) / self.grey**2))


@dataclass(frozen=True, eq=False)
class _Splitter:
    """Takes single views apart, with what all of them share."""

    settings: Classical
    shading: Shading
    scale: float
    exposure: float

    def split(self, light: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Base color and irradiance / pi, (H, W, 3) float32 each, zero where there is no surface.

        Args:
            light: (H, W, 3) exposure x radiance.
            normal: (H, W, 3) world, unit on surfaces and zero elsewhere.
        """
        surface = np.asarray(normal.any(axis=-1))
        if not surface.any():
            return np.zeros_like(light), np.zeros_like(light)
        height, width = light.shape[:2]
        shrink = min(1.0, self.settings.longest_side / max(height, width))
        small = (max(round(width * shrink), 1), max(round(height * shrink), 1))
        log_shading = np.where(surface, self.shading.log(normal), 0.0)
        log_shading += resized(self._residual(light, normal, *small), width, height)
        shading = np.exp(log_shading) / self.scale
        base_color = (light / shading[..., None]).clip(0, 1) * surface[..., None]
        irradiance = np.repeat((shading * surface / self.exposure)[..., None], 3, axis=-1)
        return base_color.astype(np.float32), irradiance.astype(np.float32)

    def _residual(self, light: np.ndarray, normal: np.ndarray, width: int, height: int) -> np.ndarray:
        normal = resized(normal, width, height)
        length = np.linalg.norm(normal, axis=-1)
        surface = length > _OPAQUE
        normal = normal / np.maximum(length, 1e-6)[..., None]
        light = np.maximum(resized(light, width, height), _FLOOR).astype(np.float64)
        chroma = chromaticity(light)
        rest = np.where(surface, np.log(luminance(light)) - self.shading.log(normal), 0.0)
        return residual_shading(
            rest,
            chroma,
            normal,
            surface,
            edge=self.settings.edge,
            chroma_edge=self.settings.chroma_edge,
            guess=self.settings._guess(self.shading, rest, chroma),
            screening=self.settings.screening,
        )
