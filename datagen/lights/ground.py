"""Ground: a plain of two colours, seen from eye height up to the horizon."""

from __future__ import annotations

from typing import Self

import numpy as np

from datagen.lights.directions import smoothstep
from datagen.lights.noise import Fractal
from datagen.spec import Number, Spec, Triple

KINDS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "grass": ((0.07, 0.11, 0.03), (0.19, 0.19, 0.07)),
    "soil": ((0.12, 0.085, 0.055), (0.27, 0.20, 0.13)),
    "sand": ((0.30, 0.24, 0.16), (0.46, 0.38, 0.27)),
    "asphalt": ((0.045, 0.045, 0.048), (0.14, 0.135, 0.13)),
    "stone": ((0.16, 0.15, 0.14), (0.38, 0.36, 0.33)),
    "snow": ((0.55, 0.58, 0.64), (0.84, 0.86, 0.90)),
}
"""Name -> linear albedos of its dark and its bright parts, orders of magnitude as in tables of albedo."""


class Ground(Spec):
    """Plain of albedos between ``dark`` and ``bright`` (linear), in patches of ``patch`` eye heights."""

    dark: Triple
    bright: Triple
    patch: Number
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator, kinds: tuple[str, ...] = tuple(KINDS)) -> Self:
        """One of the kinds, a little lighter or darker."""
        dark, bright = KINDS[kinds[int(rng.integers(len(kinds)))]]
        share = rng.uniform(0.8, 1.15) * (1.0 + rng.uniform(-0.12, 0.12, 3))
        return cls(
            dark=tuple(share * dark),
            bright=tuple(share * bright),
            patch=float(np.exp(rng.uniform(np.log(1.0), np.log(8.0)))),
            seed=int(rng.integers(2**31)),
        )

    def mean(self) -> np.ndarray:
        """(3,) mean albedo."""
        return 0.5 * (np.asarray(self.dark) + np.asarray(self.bright))

    def albedo(self, directions: np.ndarray) -> np.ndarray:
        """Linear albedo (N, 3) of the ground in directions (N, 3) with z < 0."""
        points, _ = on_ground(directions)
        broad = Fractal(self.seed, "patches")(points / self.patch, 5)
        fine = Fractal(self.seed, "grain")(points * 4.0, 5, 0.8)
        mixed = 0.5 + 0.5 * np.tanh(3.0 * (broad - 0.5) + 6.0 * (fine - 0.5))
        shaded = 1.0 - 0.55 * smoothstep(fine, 0.56, 0.64) * smoothstep(broad, 0.4, 0.6)
        spread = np.asarray(self.bright) - np.asarray(self.dark)
        return (np.asarray(self.dark) + mixed[:, None] * spread) * shaded[:, None]


def on_ground(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) of the ground and their distances (N,), in eye heights, in directions (N, 3), z < 0."""
    distance = 1.0 / np.maximum(-directions[:, 2], 1e-3)
    return directions[:, :2] * distance[:, None], distance
