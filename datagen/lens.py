"""Lens and hand: point spread, shake and vignetting on linear light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve
from scipy.special import erf

STEPS = 33
"""Places along the way of a shake that a kernel is the mean of."""

REACH = 4.0
"""Standard deviations at which a point spread ends."""


@dataclass(frozen=True)
class Blur:
    """Blur of one photo.

    Attributes:
        spread: standard deviation of the Gaussian point spread, pixels.
        motion: length of the straight way that the image moves while it is taken, pixels.
        motion_deg: direction of that way in the image, from x towards y.
    """

    spread: float = 0.0
    motion: float = 0.0
    motion_deg: float = 0.0

    def kernel(self) -> np.ndarray:
        """(2 r + 1, 2 r + 1) float64 weights of sum 1, none negative, point-symmetric.

        Each is the Gaussian's integral over its pixel: samples at the pixels' centres would make a spread of
        a third of a pixel no spread at all.
        """
        radius = int(np.ceil(0.5 * self.motion + REACH * self.spread))
        way = 0.5 * self.motion * np.linspace(-1.0, 1.0, STEPS)
        angle = np.radians(self.motion_deg)
        across = _pixel_integrals(way * np.cos(angle), self.spread, radius)
        down = _pixel_integrals(way * np.sin(angle), self.spread, radius)
        weights = down.T @ across
        weights = 0.5 * (weights + weights[::-1, ::-1])
        return weights / weights.sum()

    def on(self, light: np.ndarray) -> np.ndarray:
        """Linear light (H, W, 3) blurred, float32; beyond its edge it goes on as at the edge."""
        kernel = self.kernel()
        if kernel.size == 1:
            return light.astype(np.float32)
        return convolve(light.astype(np.float32), kernel[..., None], mode="nearest")


def vignette(width: int, height: int, corner: float) -> np.ndarray:
    """(H, W, 1) float32 share of the light that arrives: 1 in the middle, 1 - ``corner`` in the corners."""
    x = (np.arange(width) + 0.5) / width * 2 - 1
    y = (np.arange(height) + 0.5) / height * 2 - 1
    diagonal = width**2 + height**2
    squared = ((x * width) ** 2 + (y * height)[:, None] ** 2) / diagonal
    return (1.0 - corner * squared).astype(np.float32)[..., None]


def _pixel_integrals(centres: np.ndarray, spread: float, radius: int) -> np.ndarray:
    """(N, 2 r + 1): integrals over pixels -r to r of Gaussians at ``centres`` (N,)."""
    edges = np.arange(-radius, radius + 2) - 0.5
    # A point is a Gaussian much narrower than any step between places.
    below = 0.5 * (1 + erf((edges - centres[:, None]) / (np.sqrt(2) * max(spread, 1e-6))))
    return np.diff(below, axis=1)
