"""Gradient noise, cellular noise and random numbers a cell, on lattices tabulated once.

Points come as (3, N) float32: a coordinate at a time, which NumPy reads without strides. The lattices repeat
after PERIOD cells; octaves are turned against each other, so that no repetition lines up.

Sources: Perlin, "Improving noise" (2002); Worley, "A cellular texture basis function" (1996); Musgrave's sums
of octaves in "Texturing and modeling" (2003).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tron.seeds import generator

_BITS = 6
PERIOD = 2**_BITS
"""Cells after which the lattices repeat along each axis."""

_CELLS = PERIOD**3
_TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]], np.float32)
"""Rotation between octaves."""


def _directions() -> np.ndarray:
    drawn = generator(0, "materials", "gradients").normal(size=(3, _CELLS))
    return (drawn / np.linalg.norm(drawn, axis=0)).astype(np.float32)


_GRADIENTS = tuple(_directions())
_RANDOM = tuple(generator(0, "materials", "cells").random((4, _CELLS)).astype(np.float32))


def gradient_noise(points: np.ndarray) -> np.ndarray:
    """Perlin's noise (N,) at points (3, N) in cells: smooth, 0 on average, hardly ever beyond -1 or 1."""
    whole = np.floor(points)
    f = points - whole
    cell = whole.astype(np.int64)
    near = [(c & (PERIOD - 1)) << (_BITS * k) for k, c in enumerate(cell)]
    far = [((c + 1) & (PERIOD - 1)) << (_BITS * k) for k, c in enumerate(cell)]
    fade = f * f * f * (f * (f * 6.0 - 15.0) + 10.0)
    planes = []
    for z, fz in ((near[2], f[2]), (far[2], f[2] - 1.0)):
        rows = []
        for y, fy in ((near[1], f[1]), (far[1], f[1] - 1.0)):
            base = z | y
            ends = []
            for x, fx in ((near[0], f[0]), (far[0], f[0] - 1.0)):
                index = base | x
                slope = _GRADIENTS[0].take(index) * fx
                slope += _GRADIENTS[1].take(index) * fy
                slope += _GRADIENTS[2].take(index) * fz
                ends.append(slope)
            rows.append(ends[0] + fade[0] * (ends[1] - ends[0]))
        planes.append(rows[0] + fade[1] * (rows[1] - rows[0]))
    return np.float32(1.5) * (planes[0] + fade[2] * (planes[1] - planes[0]))


def fbm(points: np.ndarray, octaves: int = 4, gain: float = 0.5) -> np.ndarray:
    """Sum of octaves of gradient noise (N,), each twice as fine, ``gain`` times as strong; about [-1, 1]."""
    total, weight, norm = np.zeros(points.shape[1], np.float32), 1.0, 0.0
    for octave in range(octaves):
        total += np.float32(weight) * gradient_noise(points)
        norm += weight * weight
        weight *= gain
        if octave < octaves - 1:
            points = np.float32(2.03) * (_TURN @ points) + np.float32(7.31)
    return total * np.float32(1.0 / np.sqrt(norm))


def ridged(points: np.ndarray, octaves: int = 4, gain: float = 0.5) -> np.ndarray:
    """Sum of octaves of 1 - |noise| (N,) in [0, 1]: sharp crests, as veins and furrows have them."""
    total, weight, norm = np.zeros(points.shape[1], np.float32), 1.0, 0.0
    for octave in range(octaves):
        crest = 1.0 - np.minimum(np.abs(2.0 * gradient_noise(points)), 1.0)
        total += np.float32(weight) * crest * crest
        norm += weight
        weight *= gain
        if octave < octaves - 1:
            points = np.float32(2.03) * (_TURN @ points) + np.float32(7.31)
    return total * np.float32(1.0 / norm)


class Cells(NamedTuple):
    """Cellular noise: distances to the nearest and the second nearest feature, and numbers of the nearest.

    Attributes:
        first, second: (N,) in cells.
        random: four (N,) in [0, 1), each cell's own.
    """

    first: np.ndarray
    second: np.ndarray
    random: tuple[np.ndarray, ...]


def worley(points: np.ndarray, jitter: float = 0.9) -> Cells:
    """Cellular noise of points (3, N) in cells; features lie up to half of ``jitter`` off the centres."""
    whole = np.floor(points)
    f = points - whole
    cell = whole.astype(np.int64)
    n = points.shape[1]
    first, second = np.full(n, 9.0, np.float32), np.full(n, 9.0, np.float32)
    nearest = np.zeros(n, np.int64)
    sides = [[((c + step) & (PERIOD - 1)) << (_BITS * k) for step in (-1, 0, 1)] for k, c in enumerate(cell)]
    for i in range(3):
        for j in range(3):
            base = sides[2][i] | sides[1][j]
            for k in range(3):
                index = base | sides[0][k]
                away = np.zeros(n, np.float32)
                for axis, step in enumerate((k - 1, j - 1, i - 1)):
                    offset = np.float32(jitter) * (_RANDOM[axis].take(index) - np.float32(0.5))
                    difference = offset + (np.float32(step + 0.5) - f[axis])
                    away += difference * difference
                second = np.minimum(second, np.maximum(first, away))
                closer = away < first
                nearest = np.where(closer, index, nearest)
                first = np.minimum(first, away)
    # The features' own numbers must not follow from where they lie.
    other = (nearest * 40503 + 12289) & (_CELLS - 1)
    return Cells(np.sqrt(first), np.sqrt(second), tuple(table.take(other) for table in _RANDOM))


def cell_random(*cells: np.ndarray) -> tuple[np.ndarray, ...]:
    """Four numbers (N,) in [0, 1) of each cell of one, two or three whole coordinates (N,)."""
    index = np.zeros(len(cells[0]), np.int64)
    for step, cell in zip((1, 613, 40503), cells):
        index += cell.astype(np.int64) * step
    index = (index * 40503) & (_CELLS - 1)
    return tuple(table.take(index) for table in _RANDOM)
