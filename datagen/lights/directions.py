"""Directions, soft edges and tints that the families of light share."""

from __future__ import annotations

import numpy as np


def direction(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Unit vector (3,), world, z up; azimuth from +x towards +y."""
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def edge(distance_deg: np.ndarray, softness_deg: float) -> np.ndarray:
    """Smoothstep from 0 at -softness to 1 at +softness."""
    return _fade(distance_deg / (2.0 * softness_deg) + 0.5)


def smoothstep(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Smoothstep from 0 at ``low`` to 1 at ``high``."""
    return _fade((x - low) / (high - low))


def _fade(t: np.ndarray) -> np.ndarray:
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def tint(rng: np.random.Generator, strength: float) -> np.ndarray:
    """A colour (3,) of luminance about one, from cool to warm."""
    warmth = rng.uniform(-strength, strength)
    return np.array([1.0 + warmth, 1.0 + 0.1 * rng.uniform(-strength, strength), 1.0 - warmth])
