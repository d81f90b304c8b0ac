"""From a view's image to linear light, by the curve it is thought to have been displayed with."""

from __future__ import annotations

from functools import cache

import numpy as np

from tron.captures import View
from tron.captures.view import ToneCurve
from tron.color import agx, linear_to_srgb, srgb_to_linear

_TABLE = 4096
_AGX_STOPS = (-12.4, 4.0)  # within the range that AgX does not clip


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
