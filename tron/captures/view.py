"""Posed view: a camera, its image, and maps that say more about its pixels; its light, by a display curve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Literal, NamedTuple, get_args

import numpy as np

from tron.cameras import Camera
from tron.color import agx, linear_to_srgb, srgb_to_linear
from tron.errors import TronError

ColorSpace = Literal["linear", "display"]

ToneCurve = Literal["srgb", "agx"]
"""Curve that display values went through: a camera's, taken for sRGB, or AgX, that of path-traced views."""

Pixels = np.ndarray | Callable[[], np.ndarray]
"""An array, or what reads one when it is asked for, such as ``partial(read_image, path)``."""
FLOOR = 2e-3
"""Linear light below which 8 bits hold no colour."""
CLIPPED = 0.985
"""Display values from here on hold no radiance: the photo's white."""
_TOLERANCE = 1e-3
_WHOLE = 0.99
"""A pixel of a reduced photo is believed if all of its pixels are."""
_AGREED = 0.5  # length of a mean of unit normals
_TABLE = 4096
_AGX_STOPS = (-12.4, 4.0)  # within the range that AgX does not clip


class Map(NamedTuple):
    """Channels of a view's image or map, and the range of its values."""

    channels: int
    low: float = 0.0
    high: float = np.inf


MAPS = {
    "image": Map(3),
    "normal": Map(3, low=-np.inf),
    "base_color": Map(3, high=1.0),
    "roughness": Map(1, high=1.0),
    "metallic": Map(1, high=1.0),
    "irradiance": Map(3),
    "mask": Map(1, high=1.0),
    "sky_mask": Map(1, high=1.0),
    "valid": Map(1, high=1.0),
    "depth": Map(1),
}
"""The image and the maps of a view by the names of its fields; those of display images are at most 1."""


@dataclass(frozen=True, eq=False)
class View:
    """View of one camera. Arrays are checked at once, readers when they are read.

    Attributes:
        name: unique within a capture.
        camera: the view; its size is the size of every map.
        image: (H, W, 3) float32, in the space named by ``space``.
        space: "display", photos as stored and AgX pictures, or "linear", scene-referred radiance.
        normal: (H, W, 3) world, unit, or zero where nothing is known.
        base_color: (H, W, 3) linear, in [0, 1].
        roughness: (H, W) in [0, 1].
        metallic: (H, W) in [0, 1].
        irradiance: (H, W, 3) linear irradiance / pi, the radiance of a white diffuse surface.
        mask: (H, W) in [0, 1], 1 on the subject; the alpha of an RGBA picture, whose colours are straight.
        sky_mask: (H, W) in [0, 1], 1 on the sky.
        valid: (H, W) in [0, 1], below 1 where the image is not to be believed, such as on a passer-by:
            nothing is learnt from these pixels, nothing is judged by them.
        depth: (H, W) distance from the camera's position along the pixel's ray, world units; 0 where nothing
            is known.

    Raises:
        TronError: no name, an unknown colour space, or an array that the camera contradicts, that is not
            finite or outside its range.
    """

    name: str
    camera: Camera
    image: Pixels
    space: ColorSpace
    normal: Pixels | None = None
    base_color: Pixels | None = None
    roughness: Pixels | None = None
    metallic: Pixels | None = None
    irradiance: Pixels | None = None
    mask: Pixels | None = None
    sky_mask: Pixels | None = None
    valid: Pixels | None = None
    depth: Pixels | None = None

    def __post_init__(self) -> None:
        if not self.name:
            raise TronError("a view has no name", mend="name it after its image file")
        if self.space not in get_args(ColorSpace):
            raise TronError(
                f"colour space of an image is {self.space!r}", f"view {self.name}", "say linear or display"
            )
        for field in MAPS:
            value = getattr(self, field)
            if value is not None and not callable(value):
                object.__setattr__(self, field, self._checked(field, np.asarray(value)))

    def has(self, field: str) -> bool:
        """Whether the view has this map."""
        return getattr(self, field) is not None

    def believed(self) -> np.ndarray:
        """(H, W) bool: pixels whose image counts; all of them where the view has no ``valid``."""
        if self.valid is None:
            return np.ones((self.camera.height, self.camera.width), bool)
        return self.read("valid") > _WHOLE

    def read(self, field: str = "image") -> np.ndarray:
        """The image or a map, float32, read now if it was not yet: (H, W, 3), or (H, W) for scalar maps.

        Raises:
            TronError: the view lacks this map, or what was read is wrong (see the class).
        """
        value = getattr(self, field)
        if value is None:
            raise TronError(f"the view has no {field} map", f"view {self.name}")
        return self._checked(field, np.asarray(value())) if callable(value) else value

    def reduced(self, times: float) -> View:
        """The same view with sides that are ``times`` smaller: each pixel is the mean of its area.

        Maps are read when they are asked for. Display values are averaged as they are, as photos are reduced
        when they are loaded. Normals are unit again, or zero where they contradict one another. Depth is left
        out: its mean over an edge lies on no surface.
        """
        if times == 1:
            return self
        width, height = (max(round(side / times), 1) for side in (self.camera.width, self.camera.height))
        maps = {name: partial(self._reduced, name, (width, height)) for name in MAPS if self.has(name)}
        maps.pop("depth", None)
        return View(self.name, self.camera.resized(width, height), space=self.space, **maps)

    def window(self, x: int, y: int, width: int, height: int) -> View:
        """Part of the view, its upper left pixel at (x, y) of this one's; maps are read when asked for."""

        def part(field: str) -> np.ndarray:
            return self.read(field)[y : y + height, x : x + width]

        maps = {name: partial(part, name) for name in MAPS if self.has(name)}
        return View(self.name, self.camera.window(x, y, width, height), space=self.space, **maps)

    def _reduced(self, field: str, size: tuple[int, int]) -> np.ndarray:
        import cv2

        pixels = cv2.resize(self.read(field), size, interpolation=cv2.INTER_AREA)
        if field != "normal":
            return pixels
        length = np.linalg.norm(pixels, axis=-1, keepdims=True)
        return np.where(length > _AGREED, pixels / np.maximum(length, _AGREED), 0)

    def _checked(self, field: str, value: np.ndarray) -> np.ndarray:
        where, height, width = f"view {self.name}", self.camera.height, self.camera.width
        pixels = value
        channels, low, high = MAPS[field]
        if field == "image" and self.space == "display":
            high = 1.0
        if channels == 1 and pixels.shape == (height, width, 1):
            pixels = pixels[..., 0]
        expected = (height, width) if channels == 1 else (height, width, channels)
        if pixels.shape != expected:
            raise TronError(f"{field} has shape {pixels.shape}, its camera says {expected}", where)
        pixels = np.ascontiguousarray(pixels, np.float32)
        bad = ~np.isfinite(pixels)
        if bad.any():
            raise TronError(f"{field} holds {bad.sum()} values that are NaN or infinite", where)
        if pixels.min() < low - _TOLERANCE or pixels.max() > high + _TOLERANCE:
            raise TronError(
                f"{field} ranges from {pixels.min():.4g} to {pixels.max():.4g}",
                where,
                f"values must lie between {low:g} and {high:g}",
            )
        return pixels


def linear_light(view: View, exposure: float, curve: ToneCurve) -> np.ndarray:
    """(H, W, 3) float32, not negative: exposure x radiance.

    Photos are decoded from sRGB: what a camera's own tone curve did besides is not known. Pictures of
    path-traced views went through AgX, which "agx" inverts as far as 8 bits and clipping let it.
    """
    image = view.read()
    if view.space == "linear":
        return np.maximum(image * np.float32(exposure), 0.0)
    return decoded(image, curve)


def decoded(display: np.ndarray, curve: ToneCurve) -> np.ndarray:
    """(..., 3) display values in [0, 1] -> (..., 3) linear light, by the inverse of a curve."""
    return srgb_to_linear(display) if curve == "srgb" else inverse_agx(display)


def encoded(linear: np.ndarray, curve: ToneCurve) -> np.ndarray:
    """(..., 3) linear light -> (..., 3) display values in [0, 1], by a curve."""
    return np.clip(linear_to_srgb(linear), 0, 1) if curve == "srgb" else agx(linear)


def inverse_agx(display: np.ndarray) -> np.ndarray:
    """(..., 3) AgX display values -> (..., 3) linear float32; colours out of gamut are clipped at zero."""
    linear, shown, inset = _agx_tables()
    blended = np.interp(display, shown, linear)
    return np.maximum(blended @ np.linalg.inv(inset), 0.0).astype(np.float32)


@cache
def _agx_tables() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The curve of greys, and the matrix before it as (from, to), read off tron.color's one AgX."""
    linear = np.exp2(np.linspace(*_AGX_STOPS, _TABLE))
    shown = agx(np.repeat(linear[:, None], 3, axis=1))[:, 0]
    return linear, shown, np.interp(agx(np.eye(3)), shown, linear)
