"""Materials drawn in strata, so that every kind appears whatever the seed."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

BRIGHTNESS = {
    "black": (0.02, 0.05),
    "dark": (0.05, 0.2),
    "grey": (0.2, 0.6),
    "light": (0.6, 0.9),
    "white": (0.9, 1.0),
    "saturated": (0.5, 1.0),
}
"""Kind of a base color -> range of its largest channel, linear."""
POLISHED, ROUGH = 0.2, 0.3
"""Roughness up to which a material counts as polished, and from which as rough."""
STRATA = (
    (0.05, 0.12),
    (0.12, POLISHED),
    (POLISHED, ROUGH),
    (ROUGH, 0.5),
    (0.5, 0.7),
    (0.7, 0.95),
    (1.0, 1.0),
)
"""Of a ball's roughness; the last is glTF's default."""
WIDE_STRATA = ((0.05, 0.25), (0.25, 0.6), (0.6, 1.0))
"""Of the other shapes'."""


class Material(NamedTuple):
    """Material of one surface.

    Attributes:
        color: kind of its base color, of :data:`BRIGHTNESS`.
        base_color: linear RGB.
        roughness: in [0.05, 1].
        metallic: 0 or 1.
    """

    color: str
    base_color: tuple[float, float, float]
    roughness: float
    metallic: float

    @property
    def words(self) -> str:
        """Description, such as ``metal 0.87 saturated``."""
        return f"{'metal' if self.metallic else 'dielectric'} {self.roughness:.2f} {self.color}"


def draw_materials(
    rng: np.random.Generator, strata: Sequence[tuple[float, float]], each: int = 1
) -> list[Material]:
    """Draw metals, then dielectrics, ``each`` per stratum of roughness; kinds of color take turns."""
    count = 2 * each * len(strata)
    kinds: list[str] = []
    while len(kinds) < count:
        kinds += rng.permutation(list(BRIGHTNESS)).tolist()
    return [
        Material(
            color, _base_color(rng, color), float(rng.uniform(*strata[n // each % len(strata)])), metallic
        )
        for n, (color, metallic) in enumerate(zip(kinds, np.repeat([1.0, 0.0], count // 2).tolist()))
    ]


def _base_color(rng: np.random.Generator, kind: str) -> tuple[float, float, float]:
    """Draw a base color, saturated or with a tint of a tenth."""
    saturation = rng.uniform(0.8, 1) if kind == "saturated" else rng.uniform(0, 0.1)
    return colorsys.hsv_to_rgb(rng.random(), saturation, rng.uniform(*BRIGHTNESS[kind]))
