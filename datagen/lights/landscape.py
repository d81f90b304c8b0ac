"""Open country and streets: sky and ground behind hills, trees and buildings along the horizon."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Literal, Self

import numpy as np

from datagen.lights.clouds import plain
from datagen.lights.directions import smoothstep
from datagen.lights.discs import Disc
from datagen.lights.ground import Ground
from datagen.lights.light import Light
from datagen.lights.noise import Fractal
from datagen.lights.weather import Above, Weather
from datagen.spec import Number, Spec, Triple

Outline = Literal["hills", "trees", "buildings"]

SOFT_DEG = 0.4
"""Width of a silhouette's edge; of trees' more."""

GLASS = 0.12
"""Radiance of a window by day, relative to the sky that it mirrors."""


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


class LandscapeSpec(Light):
    """Weather over a plain, seen past rows of hills, trees and buildings, far ones first."""

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
            share = _covered(ridge, d)
            seen = np.flatnonzero(share > 0.0)
            body = self._body(ridge, d[seen])
            index, cover = near[seen], share[seen, None]
            image[index] = image[index] * (1.0 - cover) + body * cover
        return image

    def discs(self) -> Sequence[Disc]:
        sun = self._above.disc
        open_share = np.prod([1.0 - _covered(ridge, sun.toward[None]) for ridge in self.ridges])
        return [Disc(sun.toward, sun.diameter_deg, sun.irradiance * float(open_share))]

    def _body(self, ridge: Ridge, directions: np.ndarray) -> np.ndarray:
        """Radiance of the things themselves: they face us, and the sun lights those that face it too."""
        above, sun = self._above, self._above.weather.toward
        azimuth, elevation = _angles(directions)
        level = directions * (1.0, 1.0, 0.0)
        level /= np.linalg.norm(level, axis=1, keepdims=True)
        fractal = Fractal(ridge.seed, "body")
        around = np.stack([azimuth, elevation], axis=1)
        if ridge.outline == "buildings":
            house, across, tone = _houses(ridge, azimuth)
            turn = np.radians(140.0) * (tone - 0.5)  # fronts that do not all face us
            cos, sin = np.cos(turn), np.sin(turn)
            facing = -level @ sun * cos + np.cross(level[:, :2], sun[:2]) * sin
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
            pane = _panes(ridge, house, across, elevation)[:, None]
            body = body * (1.0 - pane) + pane * GLASS * above.horizon(-directions)
        air = above.horizon(directions)
        return body * (1.0 - ridge.haze) + air * ridge.haze


def _angles(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth in [0, 360) and elevation of directions (N, 3), degrees."""
    azimuth = np.degrees(np.arctan2(directions[:, 1], directions[:, 0])) % 360.0
    return azimuth, np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))


def _covered(ridge: Ridge, directions: np.ndarray) -> np.ndarray:
    """Share (N,) of what lies behind that a ridge hides."""
    azimuth, elevation = _angles(directions)
    ring = np.stack([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))], axis=1)
    bumps = 57.0 / ridge.width_deg
    fractal = Fractal(ridge.seed, "outline")
    # A ridge is absent over a part of the horizon.
    standing = smoothstep(fractal(ring * 1.7 + 90.0, 2), *_edges(1.0 - ridge.share))
    if ridge.outline == "buildings":
        _, _, tone = _houses(ridge, azimuth)
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


def _houses(ridge: Ridge, azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number of the house in a direction, the place (0 to 1) across it, and a number in (0, 1) of its own."""
    count = max(int(360.0 / ridge.width_deg), 3)
    place = azimuth / 360.0 * count
    house = np.floor(place).astype(int) % count
    tone = Fractal(ridge.seed, "houses")(np.stack([house * 3.0, house * 0.0], axis=1), 1)
    return house, place - np.floor(place), tone


def _panes(ridge: Ridge, house: np.ndarray, across: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """1 in a window, 0 on the wall between."""
    columns = 3 + house * 7 % 4
    x, y = across * columns % 1.0, elevation / ridge.height_deg * (6 + house * 5 % 5) % 1.0
    return ((x > 0.25) & (x < 0.75) & (y > 0.3) & (y < 0.8) & (elevation > 0.0)).astype(float)
