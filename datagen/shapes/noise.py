"""Fractal noise in space: octaves of a periodic random lattice, interpolated by cubic B-splines."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

LATTICE = 16
"""Points a side of the periodic lattice."""


class Noise:
    """Fractal noise of zero mean and unit variance over its lattice.

    Octave k has ``2^k`` times the frequency and ``gain^k`` times the amplitude of octave 0 (Perlin 1985, with
    spline-interpolated values in place of gradients).

    Args:
        rng: source of the lattice and of each octave's offset.
        octaves: how many.
        gain: amplitude of an octave over that of the one below it; 0.5 is rock, 0.3 is smooth.
    """

    def __init__(self, rng: np.random.Generator, octaves: int = 4, gain: float = 0.5):
        lattice = spline_filter(rng.standard_normal((LATTICE,) * 3), order=3, mode="grid-wrap")
        line = np.stack(np.meshgrid(*[np.arange(0, LATTICE, 0.5)] * 3, indexing="ij")).reshape(3, -1)
        values = map_coordinates(lattice, line, order=3, mode="grid-wrap", prefilter=False)
        self._lattice = (lattice - values.mean()) / values.std()
        self._offsets = rng.uniform(0.0, LATTICE, (octaves, 3))
        self._amplitudes = gain ** np.arange(octaves)
        self._amplitudes /= np.linalg.norm(self._amplitudes)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """(N,) values at ``points`` (N, 3); one unit of length is one cell of octave 0."""
        points = np.asarray(points, dtype=np.float64)
        total = np.zeros(len(points))
        for k, (offset, amplitude) in enumerate(zip(self._offsets, self._amplitudes)):
            at = (points * 2.0**k + offset).T
            total += amplitude * map_coordinates(
                self._lattice, at, order=3, mode="grid-wrap", prefilter=False
            )
        return total
