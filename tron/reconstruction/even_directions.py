"""Directions spread evenly over the sphere, without a random number."""

from __future__ import annotations

import numpy as np


def even_directions(count: int) -> np.ndarray:
    """(count, 3) unit vectors on Fibonacci's spiral (Gonzalez 2010, Measurement of areas on a sphere)."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
