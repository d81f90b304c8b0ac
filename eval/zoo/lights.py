"""Lights of the zoo: photographed maps, a drawn sun, even light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from tron.io.lat_long import directions
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.lighting import Lighting

ROWS = 128
JUDGED = {"venice": "venice_sunset_1k", "studio": "studio_small_03_1k", "warehouse": "empty_warehouse_01_1k"}
"""Maps that always light the zoo; a fourth is drawn from the others."""
SUN, EVEN = "sun", "even"
SUN_SHARE = 4.0
"""Light of the sun on a plane that faces up, over the sky's."""


@dataclass(frozen=True, eq=False)
class Light:
    """A light of the zoo.

    Attributes:
        name: name in metrics.
        environment: environment of the shapes.
    """

    name: str
    environment: EnvironmentMap

    @cached_property
    def lighting(self) -> Lighting:
        """The environment prepared for frames, on first use."""
        return Lighting(self.environment)

    @property
    def even(self) -> bool:
        """Whether few samples give the truth."""
        return self.name == EVEN


def draw_lights(maps: Path | None, seed: int) -> list[Light]:
    """Draw four maps, a sun and even light, each turned about up at random.

    Args:
        maps: folder of photographed maps (``.hdr``); maps of :data:`JUDGED` that it lacks are drawn.
        seed: root of all random numbers.
    """
    rng = generator(seed, "zoo", "lights")
    found = sorted(maps.glob("*.hdr")) if maps is not None else []
    by_name = {path.stem: path for path in found}
    if all(stem in by_name for stem in JUDGED.values()):
        others = [stem for stem in by_name if stem not in JUDGED.values()]
        files = dict(JUDGED)
        if others:
            stem = str(rng.choice(others))
            files[stem.removesuffix("_1k").replace("-", "_").lower()] = stem
        drawn = {name: EnvironmentMap.load(by_name[stem]).resized(ROWS) for name, stem in files.items()}
    else:
        drawn = {f"drawn{n}": _windows(rng) for n in range(1, 5)}
    drawn |= {SUN: _sun(rng), EVEN: EnvironmentMap.constant(1.0)}
    turned = {name: each.rotated(float(rng.uniform(0, 360))) for name, each in drawn.items()}
    return [Light(name, each) for name, each in turned.items()]


def photographed(lights: Sequence[Light]) -> bool:
    """Whether the maps are the photographed maps of the targets."""
    return all(name in [each.name for each in lights] for name in JUDGED)


def disc(elevation_deg: float, azimuth_deg: float, radius_deg: float) -> np.ndarray:
    """Return a disc of the sphere with an edge of 1.5 texels, (ROWS, 2 ROWS) in [0, 1]."""
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    level = np.cos(elevation)
    toward = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    away = np.degrees(np.arccos(np.clip(directions(ROWS, 2 * ROWS) @ toward, -1, 1)))
    return np.clip((radius_deg - away) / 2 + 0.5, 0, 1)


def _sky(rng: np.random.Generator, zenith: float, horizon: float, ground: float) -> np.ndarray:
    up = directions(ROWS, 2 * ROWS)[..., 2:]
    tint = 1 + rng.uniform(-0.15, 0.15, 3)
    return np.where(up > 0, horizon + (zenith - horizon) * np.clip(up, 0, 1), ground) * tint


def _sun(rng: np.random.Generator) -> EnvironmentMap:
    """Draw a disc of 2 degrees' radius, 10 to 70 degrees high, with four fifths of the light."""
    sky = _sky(rng, 0.3, 0.5, 0.12)
    lamp = disc(rng.uniform(10, 70), 0.0, 2.0)[..., None] * [1.05, 1.0, 0.9]
    share = EnvironmentMap(lamp).unoccluded_upward().mean() / EnvironmentMap(sky).unoccluded_upward().mean()
    return EnvironmentMap(sky + lamp * (SUN_SHARE / share))


def _windows(rng: np.random.Generator) -> EnvironmentMap:
    """Draw a dim room with three lamps or windows, a few to a few dozen degrees wide."""
    light = _sky(rng, 0.25, 0.2, 0.1)
    for _ in range(3):
        radius = float(np.exp(rng.uniform(np.log(4), np.log(25))))
        lamp = disc(rng.uniform(-20, 80), rng.uniform(0, 360), radius)
        light = light + lamp[..., None] * rng.uniform(0.3, 3) * (20 / radius) ** 2 * (
            1 + rng.uniform(-0.2, 0.2, 3)
        )
    return EnvironmentMap(light)
