"""Colours and coordinates that families share: mixtures, steps, palettes, planes of a solid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datagen.spec import Triple


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Hermite's step from 0 at ``low`` to 1 at ``high``; falling where ``low`` is the greater."""
    t = np.clip((x - np.float32(low)) * np.float32(1.0 / (high - low)), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def mix(a: np.ndarray | float, b: np.ndarray | float, t: np.ndarray | float) -> np.ndarray:
    """a where t is 0, b where it is 1."""
    return np.asarray(a + (b - a) * t, np.float32)


def column(color: Triple) -> np.ndarray:
    """A colour (3, 1) that broadcasts over points (3, N)."""
    return np.asarray(color, np.float32)[:, None]


def near(rng: np.random.Generator, palette: Sequence[Triple], spread: float = 0.15) -> Triple:
    """A linear colour near one of a palette: brightness varies by ``spread``, each channel by a third of it.

    The variation is in the logarithm, so dark colours stay dark and hues stay what they are.
    """
    chosen = np.asarray(palette[int(rng.integers(len(palette)))], np.float64)
    scale = np.exp(spread * rng.uniform(-1.0, 1.0) + spread / 3.0 * rng.uniform(-1.0, 1.0, 3))
    r, g, b = np.clip(chosen * scale, 0.02, 0.88).tolist()
    return r, g, b


def darker(color: Triple, factor: float) -> Triple:
    """The colour times ``factor``."""
    r, g, b = color
    return r * factor, g * factor, b * factor


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between two positive ones, even in its logarithm: scales have no favourite."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def turned(points: np.ndarray, axis: Triple) -> np.ndarray:
    """Points (3, N) in a right-handed frame whose third axis is the unit vector ``axis``."""
    third = np.asarray(axis, np.float64)
    helper = np.eye(3)[int(np.argmin(np.abs(third)))]
    first = np.cross(helper, third)
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(third, first), third]).astype(np.float32)
    return frame @ points


def laid(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates u, v (N,) of a flat pattern on the side that a surface faces most, and that side (N,).

    On walls v is up; on floors u and v are x and y.
    """
    side = np.argmax(np.abs(normals), axis=0)
    u = np.where(side == 0, points[1], points[0])
    v = np.where(side == 2, points[1], points[2])
    return u, v, side


def direction(rng: np.random.Generator, flat: bool = False) -> Triple:
    """A unit vector; in the plane of x and y where ``flat``."""
    drawn = rng.normal(size=3)
    if flat:
        drawn[2] = 0.0
    x, y, z = (drawn / np.linalg.norm(drawn)).tolist()
    return x, y, z
