"""Silhouettes along the horizon: hills, trees and buildings at one distance each."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.lights.light import smoothstep
from datagen.world.lights.noise import Fractal
from datagen.world.spec import Number, Spec, Triple

Outline = Literal["hills", "trees", "buildings"]

SOFT_DEG = 0.4
"""Width of a silhouette's edge; of trees' more."""


class Ridge(Spec):
    """Things of one kind at one distance around the horizon.

    Attributes:
        height_deg: of the highest, above the horizon.
        width_deg: of one bump, crown or front.
        albedo: linear, of what they are made of.
        haze: share of the light that the air in front of them hides.
        share: of the horizon where they stand; elsewhere they sink below it.
    """

    outline: Outline
    height_deg: Number
    width_deg: Number
    albedo: Triple
    haze: Number
    share: Number
    seed: int

    def highest(self) -> float:
        """Sine of an elevation that nothing of it reaches above."""
        return float(np.sin(np.radians(min(1.7 * self.height_deg + 2.0, 90.0))))

    @classmethod
    def draw(cls, rng: np.random.Generator, outline: Outline, far: float) -> Self:
        """One of the outline given; ``far`` is 0 for the nearest and 1 for the farthest."""
        height, width, albedo = {
            "hills": ((3.0, 16.0), (15.0, 50.0), (0.10, 0.11, 0.07)),
            "trees": ((10.0, 55.0), (4.0, 16.0), (0.035, 0.05, 0.02)),
            "buildings": ((12.0, 60.0), (10.0, 40.0), (0.26, 0.23, 0.20)),
        }[outline]
        share = 1.0 + rng.uniform(-0.35, 0.25, 3) if outline == "buildings" else 1.0
        return cls(
            outline=outline,
            height_deg=rng.uniform(*height) * (1.0 - 0.55 * far),
            width_deg=rng.uniform(*width) * (1.0 - 0.5 * far),
            albedo=tuple(np.asarray(albedo) * rng.uniform(0.6, 1.5) * share),
            haze=far * rng.uniform(0.1, 0.6),
            share=rng.uniform(0.25, 1.0),
            seed=int(rng.integers(2**31)),
        )


def angles(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth in [0, 360) and elevation of directions (N, 3), degrees."""
    azimuth = np.degrees(np.arctan2(directions[:, 1], directions[:, 0])) % 360.0
    return azimuth, np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))


def covered(ridge: Ridge, directions: np.ndarray) -> np.ndarray:
    """Share (N,) of what lies behind that a ridge hides."""
    azimuth, elevation = angles(directions)
    ring = np.stack([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))], axis=1)
    bumps = 57.0 / ridge.width_deg
    fractal = Fractal(ridge.seed, "outline")
    # A ridge is absent over a part of the horizon.
    standing = smoothstep(fractal(ring * 1.7 + 90.0, 2), *_edges(1.0 - ridge.share))
    if ridge.outline == "buildings":
        _, _, tone = houses(ridge, azimuth)
        top = ridge.height_deg * (0.25 + 0.75 * tone) * (standing > 0.5)
        soft = SOFT_DEG
    elif ridge.outline == "trees":
        crowns = np.abs(2.0 * fractal(ring * bumps, 5) - 1.0)
        top = ridge.height_deg * (0.35 + 1.3 * (0.5 - crowns)) * standing
        leaves = fractal(np.stack([azimuth, elevation], axis=1) * 1.3, 5, 0.7) - 0.5
        top = top + leaves * (0.9 * ridge.height_deg)
        soft = 2.0 * SOFT_DEG
    else:
        top = ridge.height_deg * (0.2 + 1.3 * (fractal(ring * bumps, 7, 0.45) - 0.25)) * standing
        soft = SOFT_DEG
    return smoothstep(top - elevation, -soft, soft) * smoothstep(elevation, -1.2, -0.4)


def _edges(missing: float) -> tuple[float, float]:
    return 0.2 + 0.5 * missing - 0.06, 0.2 + 0.5 * missing + 0.06


def houses(ridge: Ridge, azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number of the house in a direction, the place (0 to 1) across it, and a number in (0, 1) of its own."""
    count = max(int(360.0 / ridge.width_deg), 3)
    place = azimuth / 360.0 * count
    house = np.floor(place).astype(int) % count
    tone = Fractal(ridge.seed, "houses")(np.stack([house * 3.0, house * 0.0], axis=1), 1)
    return house, place - np.floor(place), tone


def panes(
    ridge: Ridge, house: np.ndarray, across: np.ndarray, elevation: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """1 in a window and 0 on the wall between, and the numbers of its column and its floor (from 0)."""
    x = across * (3 + house * 7 % 4)
    y = np.maximum(elevation, 0.0) / ridge.height_deg * (6 + house * 5 % 5)
    column, floor = np.floor(x), np.floor(y)
    pane = (np.abs(x - column - 0.5) < 0.25) & (np.abs(y - floor - 0.55) < 0.25) & (elevation > 0.0)
    return pane.astype(float), column, floor
