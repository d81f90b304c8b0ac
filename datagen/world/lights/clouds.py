"""Sky with clouds over open ground."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Literal, Self

import numpy as np

from datagen.world.lights.light import Disc, Light
from datagen.world.lights.weather import Above, Ground, Weather, on_ground

HORIZON = 300.0
"""Distance, in eye heights, over which the air hides a share of 1 - 1/e of the ground."""


class CloudsSpec(Light):
    """Clouds and sun of any height over a plain of varied albedo."""

    number = 4
    usual = 3
    supersamples = 2
    family: Literal["clouds"] = "clouds"
    weather: Weather
    ground: Ground

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[Light]) -> Self:  # noqa: ARG003
        return cls(weather=Weather.draw(rng), ground=Ground.draw(rng))

    @cached_property
    def _above(self) -> Above:
        return Above(self.weather, float(self.ground.mean().mean()))

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        image = np.empty(directions.shape)
        upper = directions[:, 2] > 0.0
        image[upper] = self._above.radiance(directions[upper])
        image[~upper] = plain(self._above, self.ground, directions[~upper])
        return image

    def discs(self) -> Sequence[Disc]:
        return [self._above.disc]


def plain(above: Above, ground: Ground, directions: np.ndarray) -> np.ndarray:
    """Linear radiance (N, 3) of open ground under a sky, in directions (N, 3) with z <= 0."""
    _, distance = on_ground(directions)
    lit = ground.albedo(directions) * above.level_irradiance() / np.pi
    far = above.horizon(directions)
    seen = np.exp(-distance / HORIZON)[:, None]
    return lit * seen + far * (1.0 - seen)
