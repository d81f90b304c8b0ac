"""One factor on all light of a scene, which photos do not fix: bright paint in dim light looks the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import fminbound

from tron.color import agx

COVERED = 0.999
"""Coverage from which a pixel shows nothing but surfaces."""
STOPS = 6.0
"""The factor is looked for within so many powers of two either way."""


def fitted_factor(
    lights: Sequence[tuple[np.ndarray, float, np.ndarray, np.ndarray]],
    curve: Callable[[np.ndarray], np.ndarray] = agx,
) -> float:
    """Return the factor on radiance that minimises the mean squared error of display values.

    Args:
        lights: per light: radiance (K, H, W, 3), exposure, true display values (K, H, W, 3), and a mask of
            the pixels that count (K, H, W) bool.
        curve: tone curve of exposed radiance.
    """

    def error(stops: float) -> float:
        squares = [
            np.square(curve(2.0**stops * exposure * radiance[where]) - truth[where]).ravel()
            for radiance, exposure, truth, where in lights
        ]
        return float(np.concatenate(squares).mean())

    # The error has one valley, but for plateaus where all is black or white: a coarse look finds its floor.
    coarse = np.linspace(-STOPS, STOPS, 25)
    floor, step = coarse[np.argmin([error(stops) for stops in coarse])], coarse[1] - coarse[0]
    return float(np.exp2(fminbound(error, floor - step, floor + step)))
