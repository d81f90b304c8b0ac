"""From a view's image to linear light, by the curve it is thought to have been displayed with."""

from __future__ import annotations

from functools import cache

import numpy as np

from tron.captures import View
from tron.captures.view import ToneCurve
from tron.color import agx, srgb_to_linear

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
    return srgb_to_linear(image) if curve == "srgb" else inverse_agx(image)


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
