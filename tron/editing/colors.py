"""Hue of base colors as people see it: of display values, in HSV.

Smith 1978, "Color Gamut Transform Pairs"; degrees, 0 is red.
"""

from __future__ import annotations

import cv2
import numpy as np

from tron.color import linear_to_srgb, srgb_to_linear

_GREY = 1e-4
"""Saturation below which a colour has no hue."""


def hues(base_color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M, 3) linear base colors -> (M,) hue in degrees [0, 360), and (M,) bool whether there is one."""
    angle, saturation, _ = _hsv(base_color).T
    return angle, saturation > _GREY


def with_hue(base_color: np.ndarray, angle: float | np.ndarray) -> np.ndarray:
    """(M, 3) linear base colors of another hue in degrees; saturation and value of display stay."""
    hsv = _hsv(base_color)
    hsv[:, 0] = np.mod(angle, 360)
    display = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]
    return np.clip(srgb_to_linear(display), 0, 1).astype(np.float32)


def _hsv(base_color: np.ndarray) -> np.ndarray:
    display = linear_to_srgb(np.clip(base_color, 0, 1)).astype(np.float32)
    return cv2.cvtColor(np.ascontiguousarray(display[None]), cv2.COLOR_RGB2HSV)[0]
