"""Open country and streets: sky and ground behind hills, trees and buildings along the horizon."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Literal, Self

import numpy as np

from datagen.world.lights.clouds import plain
from datagen.world.lights.horizon import Outline, Ridge, angles, covered, houses, panes
from datagen.world.lights.light import Disc, Light
from datagen.world.lights.noise import Fractal
from datagen.world.lights.weather import Above, Ground, Weather

GLASS = 0.12
"""Radiance of a window by day, relative to the sky that it mirrors."""


class LandscapeSpec(Light):
    """Weather over a plain, seen past rows of hills, trees and buildings, far ones first."""

    number = 5
    usual = 3
    supersamples = 2
    family: Literal["landscape"] = "landscape"
    weather: Weather
    ground: Ground
    ridges: tuple[Ridge, ...]

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[Light]) -> Self:  # noqa: ARG003
        weather, place = Weather.draw(rng), int(rng.integers(4))
        kinds: tuple[tuple[Outline, ...], ...] = (
            ("hills", "hills", "trees"),
            ("hills", "trees", "trees"),
            ("trees", "buildings"),
            ("buildings", "buildings", "trees"),
        )
        grounds = (("grass", "soil", "sand", "stone", "snow"),) * 2 + (("asphalt", "stone", "grass"),) * 2
        outlines = kinds[place]
        far = np.linspace(1.0, 0.0, len(outlines))
        return cls(
            weather=weather,
            ground=Ground.draw(rng, grounds[place]),
            ridges=tuple(Ridge.draw(rng, outline, float(f)) for outline, f in zip(outlines, far)),
        )

    @cached_property
    def _above(self) -> Above:
        return Above(self.weather, float(self.ground.mean().mean()))

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        above = self._above
        image = np.empty(directions.shape)
        upper = directions[:, 2] > 0.0
        image[upper] = above.radiance(directions[upper])
        image[~upper] = plain(above, self.ground, directions[~upper])
        for ridge in self.ridges:
            near = np.flatnonzero((directions[:, 2] > -0.025) & (directions[:, 2] < ridge.highest()))
            d = directions[near]
            share = covered(ridge, d)
            seen = np.flatnonzero(share > 0.0)
            body = self._body(ridge, d[seen])
            index, cover = near[seen], share[seen, None]
            image[index] = image[index] * (1.0 - cover) + body * cover
        return image

    def discs(self) -> Sequence[Disc]:
        sun = self._above.disc
        open_share = np.prod([1.0 - covered(ridge, sun.toward[None]) for ridge in self.ridges])
        return [Disc(sun.toward, sun.diameter_deg, sun.irradiance * float(open_share))]

    def _body(self, ridge: Ridge, directions: np.ndarray) -> np.ndarray:
        """Radiance of the things themselves: they face us, and the sun lights those that face it too."""
        above, sun = self._above, self._above.weather.toward
        azimuth, elevation = angles(directions)
        level = directions * (1.0, 1.0, 0.0)
        level /= np.linalg.norm(level, axis=1, keepdims=True)
        fractal = Fractal(ridge.seed, "body")
        around = np.stack([azimuth, elevation], axis=1)
        if ridge.outline == "buildings":
            house, across, tone = houses(ridge, azimuth)
            turn = np.radians(140.0) * (tone - 0.5)  # fronts that do not all face us
            cos, sin = np.cos(turn), np.sin(turn)
            aside = level[:, 0] * sun[1] - level[:, 1] * sun[0]
            facing = -level @ sun * cos + aside * sin
            texture = 0.8 + 0.4 * fractal(around * 1.5, 4)
            colour = np.asarray(ridge.albedo) * (0.5 + tone[:, None])
        else:
            grain = 2.0 if ridge.outline == "trees" else 0.35
            texture = np.exp(3.5 * (fractal(around * grain, 6, 0.7) - 0.5))
            relief = 6.0 * (fractal(around * (0.8 * grain) + 40.0, 4) - 0.5)
            facing = 0.6 * (-level @ sun) + 0.4 * sun[2] + 0.35 * relief
            colour = np.asarray(ridge.albedo)
        sky = 0.5 * above.skylight + 0.25 * self.ground.mean() * above.level_irradiance()
        light = sky + above.sunlight_below * np.maximum(facing, 0.0)[:, None]
        body = colour * texture[:, None] * light / np.pi
        if ridge.outline == "buildings":
            pane = panes(ridge, house, across, elevation)[0][:, None]
            body = body * (1.0 - pane) + pane * GLASS * above.horizon(-directions)
        air = above.horizon(directions)
        return body * (1.0 - ridge.haze) + air * ridge.haze
