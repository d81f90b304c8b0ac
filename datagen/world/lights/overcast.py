"""Dome of even cloud."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Self

import numpy as np

from datagen.world.lights.light import Light, direction, edge, tint
from datagen.world.spec import Number, Triple


class OvercastSpec(Light):
    """A cloudy dome: zenith and horizon radiance, a broad brighter patch, and the ground below (all linear).

    The dome is linear in sin(elevation): the CIE overcast sky where the horizon is a third of the zenith.
    """

    number = 2
    usual = 1
    family: Literal["overcast"] = "overcast"
    zenith: Triple
    horizon: Triple
    ground: Triple
    patch_azimuth_deg: Number
    patch_elevation_deg: Number
    patch_width_deg: Number
    patch: Triple

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[Light]) -> Self:  # noqa: ARG003
        cool = tint(rng, 0.15)
        return cls(
            zenith=tuple(rng.uniform(0.9, 1.1) * cool),
            horizon=tuple(rng.uniform(0.25, 0.9) * tint(rng, 0.12)),
            ground=tuple(rng.uniform(0.05, 0.35) * tint(rng, 0.25)),
            patch_azimuth_deg=rng.uniform(0.0, 360.0),
            patch_elevation_deg=rng.uniform(15.0, 80.0),
            patch_width_deg=rng.uniform(20.0, 50.0),
            patch=tuple(rng.uniform(0.0, 2.0) * tint(rng, 0.2)),
        )

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        z = directions[:, 2:]
        share = np.maximum(z, 0.0)
        dome = np.asarray(self.horizon) * (1.0 - share) + np.asarray(self.zenith) * share
        centre = direction(self.patch_azimuth_deg, self.patch_elevation_deg)
        angle = np.degrees(np.arccos(np.clip(directions @ centre, -1.0, 1.0)))
        dome = dome + np.exp(-0.5 * (angle / self.patch_width_deg) ** 2)[:, None] * np.asarray(self.patch)
        above = edge(np.degrees(np.arcsin(np.clip(z, -1.0, 1.0))), 4.0)
        return dome * above + np.asarray(self.ground) * (1.0 - above)
