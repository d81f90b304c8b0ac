"""Fractal noise: detail of clouds, ground and walls at every size that a texel can hold."""

from __future__ import annotations

import numpy as np

from tron.seeds import generator

LATTICE = 256
"""Cells after which the noise repeats, in each direction."""

LACUNARITY = 2.03
_TURN = 0.65  # radians between octaves, so that their lattices do not show


class Fractal:
    """Sum of octaves of value noise in the plane (Perlin 1985; Musgrave 1989), by the seed alone."""

    def __init__(self, seed: int, name: str) -> None:
        lattice = generator(seed, "fractal", name).random((LATTICE, LATTICE), np.float32)
        self._lattice = lattice.ravel()

    def __call__(self, points: np.ndarray, octaves: int = 6, gain: float = 0.5) -> np.ndarray:
        """Values (N,) float32 in [0, 1], mean one half, at points (N, 2); the first octave has unit cells."""
        x, y = np.asarray(points, np.float32).T
        total = np.zeros(len(x), np.float32)
        weight, sum_of_weights = np.float32(1.0), 0.0
        cos, sin = np.float32(LACUNARITY * np.cos(_TURN)), np.float32(LACUNARITY * np.sin(_TURN))
        for octave in range(octaves):
            total += weight * self._octave(x, y)
            sum_of_weights += float(weight)
            weight *= np.float32(gain)
            x, y = cos * x - sin * y + np.float32(17.3 + octave), sin * x + cos * y + np.float32(5.9)
        return total / np.float32(sum_of_weights)

    def threshold(self, share: float, octaves: int = 6, gain: float = 0.5) -> float:
        """Value that the noise exceeds on a ``share`` of the plane."""
        if share <= 0.0:
            return 1.0
        axis = np.arange(48) * 1.37
        points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        return float(np.quantile(self(points, octaves, gain), 1.0 - share))

    def _octave(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        left, low = np.floor(x), np.floor(y)
        fx, fy = x - left, y - low
        fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
        i, j = left.astype(np.int64) % LATTICE, low.astype(np.int64) % LATTICE * LATTICE
        right, high = (i + 1) % LATTICE, (j + LATTICE) % (LATTICE * LATTICE)
        lower = self._lattice[j + i] * (1 - fx) + self._lattice[j + right] * fx
        upper = self._lattice[high + i] * (1 - fx) + self._lattice[high + right] * fx
        return lower + (upper - lower) * fy
