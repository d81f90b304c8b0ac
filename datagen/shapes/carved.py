"""Noise-carved solids: level sets of fractal noise inside a body, one connected piece each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from manifold3d import Manifold

from datagen.shapes.noise import Noise
from datagen.shapes.shape import Kind
from datagen.shapes.solids import Parts, between, largest

EDGE = 0.085
"""Edge length of the level set's triangles; bodies are about 2 wide."""

_REACH = 1.25
_CELLS = 56


def _level_set(inside: Callable[[np.ndarray], np.ndarray]) -> Manifold:
    """Surface ``inside = 0`` within the cube of half side 1.2, its largest component.

    manifold3d asks for one point after another, too slow for noise: a grid is filled first and looked up.
    """
    line = np.linspace(-_REACH, _REACH, _CELLS)
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    values = inside(points).reshape((_CELLS,) * 3)
    step = line[1] - line[0]
    grid = values.tolist()

    def sample(x: float, y: float, z: float) -> float:
        u, v, w = (x + _REACH) / step, (y + _REACH) / step, (z + _REACH) / step
        i, j, k = min(int(u), _CELLS - 2), min(int(v), _CELLS - 2), min(int(w), _CELLS - 2)
        u, v, w = u - i, v - j, w - k
        near, far = grid[i], grid[i + 1]
        a, b, c, d = near[j], near[j + 1], far[j], far[j + 1]
        low = (a[k] * (1 - w) + a[k + 1] * w) * (1 - v) + (b[k] * (1 - w) + b[k + 1] * w) * v
        high = (c[k] * (1 - w) + c[k + 1] * w) * (1 - v) + (d[k] * (1 - w) + d[k + 1] * w) * v
        return low * (1 - u) + high * u

    return largest(Manifold.level_set(sample, [-1.2, -1.2, -1.2, 1.2, 1.2, 1.2], EDGE))


def _body(p: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Depth inside a superquadric between a ball and a rounded box; positive inside."""
    exponent = between(p[2], 2.0, 6.0)
    scale = (1.0, between(p[3], 0.75, 1.0), between(p[3], 1.0, 0.7))
    return 1.0 - (np.abs(points / scale) ** exponent).sum(axis=1) ** (1.0 / exponent)


def sponge(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Body eaten by round holes: tuff, pumice, driftwood, cheese."""
    noise = Noise(rng, octaves=2, gain=0.35)
    frequency, share = between(p[0], 1.2, 2.0), between(p[1], 0.7, 1.3)
    return [
        (
            _level_set(
                lambda points: np.minimum(_body(p, points), 0.15 * (noise(points * frequency) + share))
            ),
            0,
        )
    ]


def coral(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Sheets and bridges where noise is near zero, about a solid heart so that they hang together."""
    noise = Noise(rng, octaves=1)
    frequency, width = between(p[0], 0.9, 1.5), between(p[1], 0.45, 0.7)

    def inside(points: np.ndarray) -> np.ndarray:
        heart = 0.45 - np.linalg.norm(points, axis=1)
        sheets = 0.25 * (width - np.abs(noise(points * frequency)))
        return np.maximum(heart, np.minimum(_body(p, points), sheets))

    return [(_level_set(inside), 0)]


CARVED: dict[str, Kind] = {
    "sponge": Kind(sponge, roles=("stone",)),
    "coral": Kind(coral, roles=("any",)),
}
