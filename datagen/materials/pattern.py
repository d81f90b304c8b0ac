"""Principled materials with solid patterns: the colour of a point depends on its place alone, so no seams.

A material blends two sets of parameters, a and b, by a pattern m(p) in [0, 1]: base color (linear), roughness
and metallic. Patterns are closed formulas of the point in the object's own frame, so a mesh of any density
samples the same material. Styles A and B draw from disjoint pattern families (plain belongs to both).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from datagen.materials.material import Appearance, Material
from datagen.spec import Number, Pair, Triple

Palette = Literal["A", "B"]
PatternName = Literal["plain", "checker", "stripes", "waves", "marble", "dots", "bricks", "noise", "bands"]
PATTERNS_OF_STYLE: dict[Palette, tuple[PatternName, ...]] = {
    "A": ("plain", "checker", "stripes", "waves", "marble"),
    "B": ("plain", "dots", "bricks", "noise", "bands"),
}


class PatternSpec(Material):
    """Two parameter sets and the pattern that blends them.

    Attributes:
        pattern: name of the pattern.
        frequency: periods per world unit.
        axis: (3,) unit direction of stripes, bands and marble veins, in the object's frame.
        phase: three phases in radians that shift the pattern.
        color_a, color_b: linear base colors in [0, 1].
        roughness, metallic: their values in a and in b.
    """

    family: Literal["pattern"] = "pattern"
    pattern: PatternName
    frequency: Number
    axis: Triple
    phase: Triple
    color_a: Triple
    color_b: Triple
    roughness: Pair
    metallic: Pair

    def evaluate(self, points: np.ndarray, normals: np.ndarray) -> Appearance:  # noqa: ARG002
        weight = pattern(self, points)

        def blend(a: float | Triple, b: float | Triple) -> np.ndarray:
            first, second = np.asarray(a), np.asarray(b)
            mix = weight[:, None] if first.ndim else weight
            return (first * mix + second * (1.0 - mix)).astype(np.float32)

        return Appearance(
            blend(self.color_a, self.color_b),
            blend(*self.roughness),
            blend(*self.metallic),
            np.zeros(len(points), np.float32),
        )


def draw_pattern(rng: np.random.Generator, style: Palette, *, floor: bool = False) -> PatternSpec:
    """Draw a material of a style; floors are dielectric and coarser: they are seen at grazing angles."""
    names = PATTERNS_OF_STYLE[style]
    # A plain floor hides what the guidance does wrong with texture; objects may well be plain.
    pattern = names[int(rng.integers(1, len(names)) if floor else rng.integers(len(names)))]
    axis = rng.normal(size=3)
    if floor:
        axis[2] = 0.0
    axis /= np.linalg.norm(axis)
    low, high = (0.08, 0.85) if style == "A" else (0.04, 0.75)
    rough_a = float(rng.uniform(0.25, 0.9) if floor else rng.uniform(0.2, 0.9))
    rough_b = float(np.clip(rough_a + rng.uniform(-0.3, 0.3), 0.2, 0.95)) if rng.random() < 0.4 else rough_a
    metal_a = metal_b = 0.0
    if not floor and rng.random() < 0.25:
        metal_a = metal_b = float(rng.uniform(0.6, 1.0))
        if pattern != "plain" and rng.random() < 0.3:
            metal_b = 0.0
    frequency = float(rng.uniform(0.6, 2.0) * (0.7 if floor else 1.0))
    return PatternSpec(
        pattern=pattern,
        frequency=frequency,
        axis=tuple(axis),
        phase=tuple(rng.uniform(0.0, 2 * np.pi, 3)),
        color_a=tuple(rng.uniform(low, high, 3)),
        color_b=tuple(rng.uniform(low, high, 3)),
        roughness=(rough_a, rough_b),
        metallic=(metal_a, metal_b),
    )


def pattern(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    """Weight (N,) float64 in [0, 1] of parameter set a at points (N, 3)."""
    return _PATTERNS[material.pattern](material, np.asarray(points, dtype=np.float64))


def _plain(_material: PatternSpec, points: np.ndarray) -> np.ndarray:
    return np.ones(len(points))


def _cells(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    # The phase also keeps cell walls away from z = 0, where a floor lies exactly.
    return points * (2.0 * material.frequency) + np.asarray(material.phase) / (2 * np.pi) + (0.0, 0.0, 0.013)


def _checker(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    return np.floor(_cells(material, points)).sum(axis=1) % 2.0


def _along_axis(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    return 2 * np.pi * material.frequency * (points @ np.asarray(material.axis)) + material.phase[0]


def _stripes(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.sin(_along_axis(material, points))


def _bands(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    return (np.sin(_along_axis(material, points)) > 0.0).astype(np.float64)


def _waves(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    x, y, z = (2 * np.pi * material.frequency * points).T
    a, b, c = material.phase
    return 0.5 + 0.5 * np.sin(x + 2.0 * np.sin(0.65 * y + a) + b) * np.sin(z + 0.35 * y - 0.2 * x + c)


def _turbulence(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    """Three octaves of crossed sines, in [-1, 1]: smooth, aperiodic to the eye, and exactly repeatable."""
    total, norm = np.zeros(len(points)), 0.0
    turned = np.asarray(points) @ _TURN
    for octave in range(3):
        scale = 2 * np.pi * material.frequency * 0.8 * 1.9**octave
        a, b, c = np.asarray(material.phase) * (octave + 1)
        x, y, z = (scale * turned).T
        total += (np.sin(x + 1.3 * np.sin(y + b) + a) + np.sin(y + 1.7 * np.sin(z + c) + b)) * 0.5**octave
        norm += 2.0 * 0.5**octave
        turned = turned @ _TURN
    return total / norm


def _marble(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.sin(_along_axis(material, points) + 3.0 * _turbulence(material, points))


def _noise(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    return np.clip(0.5 + 1.6 * _turbulence(material, points), 0.0, 1.0)


def _dots(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    cell = _cells(material, points)
    distance = np.linalg.norm((cell - np.floor(cell) - 0.5) * (1.0, 1.0, 0.6), axis=1)
    return np.clip((0.36 - distance) / 0.06 + 0.5, 0.0, 1.0)


def _bricks(material: PatternSpec, points: np.ndarray) -> np.ndarray:
    cell = _cells(material, points)
    row = np.floor(cell[:, 1])
    x = 0.5 * cell[:, 0] + 0.5 * (row % 2.0)
    mortar = np.minimum(np.abs(x - np.round(x)) * 2.0, np.abs(cell[:, 1] - np.round(cell[:, 1])))
    return np.clip((mortar - 0.08) / 0.08, 0.0, 1.0)


# A rotation with no axis in common with the lattice of sines, so that octaves do not line up.
_TURN = np.linalg.qr(np.array([[0.61, -0.42, 0.35], [0.28, 0.79, -0.31], [-0.52, 0.18, 0.83]]))[0]

_PATTERNS: dict[PatternName, Callable[[PatternSpec, np.ndarray], np.ndarray]] = {
    "plain": _plain,
    "checker": _checker,
    "stripes": _stripes,
    "waves": _waves,
    "marble": _marble,
    "dots": _dots,
    "bricks": _bricks,
    "noise": _noise,
    "bands": _bands,
}
