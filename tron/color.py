"""Luminance, the sRGB curve and the AgX tone curve, for NumPy arrays and torch tensors alike.

All RGB is BT.709 (sRGB primaries, D65), channel last unless an axis is given. Gradients flow through torch
tensors; torch itself is never imported here. Sources: IEC 61966-2-1 for sRGB; Troy Sobotka's AgX
configuration (github.com/sobotka/AgX-S2O3) for AgX.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import array_api_compat
import numpy as np

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""BT.709 weights of linear R, G, B in relative luminance."""

AGX_INSET = (
    (0.842479062253094, 0.0784335999999992, 0.0792237451477643),
    (0.0423282422610123, 0.878468636469772, 0.0791661274605434),
    (0.0423756549057051, 0.0784336, 0.879142973793104),
)
"""Rows give each channel that AgX's curve is applied to as a blend of linear BT.709 R, G, B."""
MIDDLE_GREY = 0.18
"""Linear reflectance that meters set their exposure by."""
AGX_LOG2_RANGE = (-12.47393, 4.026069)
"""Base-2 logarithms that AgX's curve spans: 10 stops below and 6.5 above middle grey, 0.18."""
_AGX_PIVOT = (10 / 16.5, 0.5)  # middle grey
_AGX_SLOPE = 2.0
_AGX_TOE_POWER, _AGX_SHOULDER_POWER = 3.0, 3.25


class Grade(NamedTuple):
    """Change of AgX's picture, which is flat by itself.

    Attributes:
        contrast: factor on stops from middle grey, before the curve.
        saturation: factor on the distance of display values from their luma.
    """

    contrast: float
    saturation: float


Look = Literal["photograph", "none"]
LOOKS: dict[Look, Grade] = {"photograph": Grade(1.4, 1.15), "none": Grade(1.0, 1.0)}
"""``photograph`` rises by 0.17 a stop at middle grey, AgX by 0.12; sRGB's own curve does by 0.144, those of
cameras by some 1.2 times as much. ``none`` is AgX as published, which networks and figures see."""


def _channels(x: Any, axis: int) -> tuple[Any, Any, Any]:
    if x.shape[axis] != 3:
        raise ValueError(f"axis {axis} must hold 3 channels, shape is {tuple(x.shape)}")
    index: list[Any] = [slice(None)] * x.ndim

    def channel(i: int) -> Any:
        index[axis] = i
        return x[tuple(index)]

    return channel(0), channel(1), channel(2)


def luminance(rgb: Any, axis: int = -1) -> Any:
    """Relative luminance of linear RGB: (..., 3) -> (...), in the unit of the input."""
    r, g, b = _channels(rgb, axis)
    return LUMINANCE[0] * r + LUMINANCE[1] * g + LUMINANCE[2] * b


def srgb_to_linear(x: Any) -> Any:
    """Decode sRGB display values to linear light, elementwise; negative values stay on its linear part."""
    xp = array_api_compat.array_namespace(x)
    # The unused branch of `where` still gets gradients, so its base is kept off the power's singular point.
    curve = ((xp.where(x > 0.04045, x, xp.ones_like(x)) + 0.055) / 1.055) ** 2.4
    return xp.where(x > 0.04045, curve, x / 12.92)


def linear_to_srgb(x: Any) -> Any:
    """Encode linear light to sRGB display values, elementwise and without clamping."""
    xp = array_api_compat.array_namespace(x)
    curve = 1.055 * xp.where(x > 0.0031308, x, xp.ones_like(x)) ** (1 / 2.4) - 0.055
    return xp.where(x > 0.0031308, curve, 12.92 * x)


def agx(linear: Any, axis: int = -1, look: Look = "none") -> Any:
    """Tone-map linear BT.709 to display values in [0, 1] with Troy Sobotka's original AgX.

    Negatives to zero, inset matrix, log2 over 16.5 stops, sigmoid. The result is display-encoded already: no
    sRGB curve follows. Gradients are finite everywhere, zero where the log range clips.

    Args:
        linear: scene-linear RGB with 3 channels on ``axis``, any range; shape kept.
        axis: the channel axis.
        look: of :data:`LOOKS`; middle grey is the same in all of them.
    """
    xp = array_api_compat.array_namespace(linear)
    grade = LOOKS[look]
    rgb = _channels(xp.where(linear > 0, linear, xp.zeros_like(linear)), axis)
    low, high = AGX_LOG2_RANGE
    inset = xp.stack([r * rgb[0] + g * rgb[1] + b * rgb[2] for r, g, b in AGX_INSET], axis=axis)
    # Clamping before the logarithm rather than after it gives the same values and no infinite gradients.
    stops = xp.log2(xp.clip(inset, 2.0**low, 2.0**high))
    place = (stops - low) / (high - low)
    if look == "none":
        return _agx_sigmoid(xp, place)
    shown = _agx_sigmoid(xp, xp.clip(_AGX_PIVOT[0] + grade.contrast * (place - _AGX_PIVOT[0]), 0.0, 1.0))
    luma = xp.expand_dims(luminance(shown, axis), axis=axis)
    return xp.clip(luma + grade.saturation * (shown - luma), 0.0, 1.0)


def from_agx(display: np.ndarray) -> np.ndarray:
    """Linear BT.709 (..., 3), not negative, that :func:`agx` without a look shows as ``display`` (..., 3).

    Display values of 0 and 1 come back as the ends of AgX's range.
    """
    (px, py), slope = _AGX_PIVOT, _AGX_SLOPE

    def straight(rise: np.ndarray, full_run: float, full_rise: float, power: float) -> np.ndarray:
        # The inverse of `bent` in _agx_sigmoid.
        scale = (full_rise**-power - (slope * full_run) ** -power) ** (-1 / power)
        rise = np.clip(rise, 0.0, full_rise)
        return rise / (1 - (rise / scale) ** power) ** (1 / power) / slope

    shown = np.asarray(display, np.float64)
    toe = straight(py - shown, px, py, _AGX_TOE_POWER)
    place = px - toe + straight(shown - py, 1 - px, 1 - py, _AGX_SHOULDER_POWER)
    low, high = AGX_LOG2_RANGE
    inset = 2.0 ** (low + place * (high - low))
    return np.maximum(inset @ np.linalg.inv(np.array(AGX_INSET)).T, 0.0).astype(np.float32)


def _agx_sigmoid(xp: Any, x: Any) -> Any:
    """The AgX contrast curve on [0, 1]: slope 2 at the pivot, bent to end at (0, 0) and (1, 1)."""
    (px, py), slope = _AGX_PIVOT, _AGX_SLOPE

    def bent(run: Any, full_run: float, full_rise: float, power: float) -> Any:
        # u / (1 + (u/s)^p)^(1/p) starts with the slope; s makes the full run end at the full rise.
        scale = (full_rise**-power - (slope * full_run) ** -power) ** (-1 / power)
        u = slope * xp.clip(run, 0.0, 1.0)
        return u / (1 + (u / scale) ** power) ** (1 / power)

    toe = bent(px - x, px, py, _AGX_TOE_POWER)
    shoulder = bent(x - px, 1 - px, 1 - py, _AGX_SHOULDER_POWER)
    return xp.clip(py + shoulder - toe, 0.0, 1.0)


def to_display(linear: Any, exposure: Any, look: Look = "none") -> Any:
    """``agx(exposure * linear)``: display values in [0, 1]; the exposure is a factor, not stops."""
    return agx(exposure * linear, look=look)
