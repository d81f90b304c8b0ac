"""Night: street lamps, lit windows and shops under a nearly black sky, or at dusk."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Self

import numpy as np

from datagen.world.lights.horizon import Ridge, angles, covered, houses, panes
from datagen.world.lights.light import Disc, Light, direction, smoothstep
from datagen.world.lights.noise import Fractal
from datagen.world.lights.room import Bulb, Hits, bulbs_light
from datagen.world.lights.weather import Ground, on_ground
from datagen.world.spec import Number, Spec, Triple, between

EYE = 1.6
"""Metres of the eye above the street."""

LAMPS: tuple[tuple[float, float, float], ...] = ((1.35, 0.85, 0.35), (1.15, 0.97, 0.75), (0.9, 1.0, 1.15))
"""Linear colours of sodium lamps, warm LEDs and cold ones, of luminance about one."""


class Street(Spec):
    """Row of houses by night, ``distance`` metres away; ``lit`` is the share of its windows that shine."""

    ridge: Ridge
    distance: Number
    lit: Number
    window: Number
    seed: int


class NightSpec(Light):
    """Street at night. Radiance of one is that of a lamp's square metre of unit intensity.

    Attributes:
        zenith, glow: linear radiance of the sky above, and added at the horizon.
        wet: share of what the lamps send that the street mirrors towards the eye.
        streets: far ones first.
        lamps: places relative to the point below the eye, metres.
        moon: its irradiance, and where it stands, degrees.
    """

    number = 7
    usual = 1
    supersamples = 2
    family: Literal["night"] = "night"
    zenith: Triple
    glow: Triple
    glow_azimuth_deg: Number
    ground: Ground
    wet: Number
    streets: tuple[Street, ...]
    lamps: tuple[Bulb, ...]
    moon: Triple
    moon_azimuth_deg: Number
    moon_elevation_deg: Number
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[Light]) -> Self:  # noqa: ARG003
        far = np.linspace(1.0, 0.0, int(rng.integers(1, 4)))
        moon = rng.uniform(1e-4, 1e-2) if rng.random() < 0.3 else 0.0
        dusk = rng.random() < 0.35  # the last light of the day, and lamps that have just been lit
        zenith = between(rng, 1e-3, 2e-2) if dusk else between(rng, 2e-6, 1e-4)
        glow = between(rng, 1e-3, 3e-2) if dusk else between(rng, 3e-5, 2e-3)
        return cls(
            zenith=tuple(zenith * np.array([0.8, 0.95, 1.4])),
            glow=tuple(glow * np.array([1.3, 0.95, 0.65])),
            glow_azimuth_deg=rng.uniform(0.0, 360.0),
            ground=Ground.draw(rng, ("asphalt", "stone", "grass", "soil")),
            wet=rng.uniform(0.0, 0.5) if rng.random() < 0.5 else 0.0,
            streets=tuple(_street(rng, float(f)) for f in far),
            lamps=_lamps(rng),
            moon=tuple(moon * np.array([0.95, 1.0, 1.05])),
            moon_azimuth_deg=rng.uniform(0.0, 360.0),
            moon_elevation_deg=rng.uniform(15.0, 70.0),
            seed=int(rng.integers(2**31)),
        )

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        image = self._sky(directions)
        lower = np.flatnonzero(directions[:, 2] <= 0.0)
        image[lower] = self._street_floor(directions[lower])
        for street in self.streets:
            ridge = street.ridge
            near = np.flatnonzero((directions[:, 2] > -0.025) & (directions[:, 2] < ridge.highest()))
            share = covered(ridge, directions[near])
            seen = np.flatnonzero(share > 0.0)
            index, cover = near[seen], share[seen, None]
            image[index] = image[index] * (1.0 - cover) + self._front(street, directions[index]) * cover
        return image

    def discs(self) -> Sequence[Disc]:
        found = []
        for lamp in self.lamps:
            to = np.asarray(lamp.place) - (0.0, 0.0, EYE)
            away = float(np.linalg.norm(to))
            width = 2.0 * float(np.degrees(np.arcsin(min(lamp.radius / away, 1.0))))
            found.append(Disc(to / away, width, np.asarray(lamp.intensity) / away**2))
        if any(self.moon):
            toward = direction(self.moon_azimuth_deg, self.moon_elevation_deg)
            hidden = [covered(street.ridge, toward[None])[0] for street in self.streets]
            found.append(Disc(toward, 0.53, np.asarray(self.moon) * float(np.prod(1.0 - np.array(hidden)))))
        return found

    def _sky(self, directions: np.ndarray) -> np.ndarray:
        height = np.maximum(directions[:, 2], 0.0)
        toward = 0.6 + 0.4 * directions @ direction(self.glow_azimuth_deg, 0.0)
        plane = directions[:, :2] / (height[:, None] + 0.15)
        clouds = np.exp(3.0 * (Fractal(self.seed, "sky")(plane * 1.5, 6) - 0.5))
        glow = (np.exp(-height / 0.2) * toward * clouds)[:, None]
        return np.asarray(self.zenith) + np.asarray(self.glow) * glow

    def _street_floor(self, directions: np.ndarray) -> np.ndarray:
        points, distance = on_ground(directions)
        places = np.column_stack([EYE * points, np.zeros(len(points))]).astype(np.float32)
        normals = np.zeros_like(places)
        normals[:, 2] = 1.0
        light = bulbs_light(Hits(places, normals, np.zeros(len(points), int)), self.lamps)
        light += np.pi * (np.asarray(self.zenith) + 0.3 * np.asarray(self.glow))
        light += np.asarray(self.moon) * np.sin(np.radians(self.moon_elevation_deg))
        floor = self.ground.albedo(directions) * light / np.pi
        if self.wet:
            ripples = Fractal(self.seed, "wet")(points * 2.0, 5, 0.7)
            floor *= 1.0 - 0.5 * self.wet
            floor += self.wet * self._mirrored(directions, ripples)
        far = self._sky(directions * (1.0, 1.0, 0.0))
        seen = np.exp(-distance / 80.0)[:, None]
        return floor * seen + far * (1.0 - seen)

    def _mirrored(self, directions: np.ndarray, ripples: np.ndarray) -> np.ndarray:
        """Lamps in a wet street (N, 3): each drawn out towards the eye, torn by ripples."""
        azimuth, elevation = angles(directions)
        total = np.zeros(directions.shape)
        for lamp in self.lamps:
            to = np.asarray(lamp.place) - (0.0, 0.0, EYE)
            centre = np.degrees([np.arctan2(to[1], to[0]), np.arctan2(to[2] + 2 * EYE, np.hypot(*to[:2]))])
            across = (azimuth - centre[0] + 180.0) % 360.0 - 180.0
            along = elevation + centre[1]
            streak = np.exp(-0.5 * ((across / 1.5) ** 2 + (along / 10.0) ** 2)) * smoothstep(
                ripples, 0.35, 0.7
            )
            # 0.06: light that a water film mirrors, over the streak's solid angle.
            power = 0.06 / (2.0 * np.pi * np.radians(1.5) * np.radians(10.0))
            total += (power * streak)[:, None] * np.asarray(lamp.intensity) / (to @ to)
        return total

    def _front(self, street: Street, directions: np.ndarray) -> np.ndarray:
        """Radiance (N, 3) of a row of houses: walls in the lamps' light, and windows."""
        azimuth, elevation = angles(directions)
        house, across, tone = houses(street.ridge, azimuth)
        level = directions * (1.0, 1.0, 0.0)
        level /= np.linalg.norm(level, axis=1, keepdims=True)
        up = street.distance * np.tan(np.radians(elevation)) + EYE
        places = street.distance * level + up[:, None] * (0.0, 0.0, 1.0)
        hits = Hits(places.astype(np.float32), -level.astype(np.float32), np.zeros(len(level), int))
        light = bulbs_light(hits, self.lamps) + 0.5 * np.pi * np.asarray(self.glow)
        grain = Fractal(street.seed, "wall")(np.stack([azimuth, elevation], axis=1) * 1.2, 5, 0.7)
        walls = np.asarray(street.ridge.albedo) * (0.5 + tone[:, None]) * np.exp(2.0 * (grain - 0.5))[:, None]
        pane, column, floor = panes(street.ridge, house, across, elevation)
        which = np.stack([(house * 17 + column) * 3.0, floor * 3.0 + 0.0], axis=1)
        shining = Fractal(street.seed, "windows")
        on = (shining(which, 1) < street.lit).astype(float)
        strength = np.exp(2.5 * (shining(which + 101.0, 1) - 0.5)) * street.window
        warm = shining(which + 57.0, 1)[:, None]
        colour = np.array(LAMPS[1]) * warm + np.array(LAMPS[2]) * (1.0 - warm)
        curtains = 0.5 + shining(np.stack([azimuth, elevation], axis=1) * 4.0, 3)
        inside = (pane * on * strength * curtains)[:, None] * colour
        # Shops: one bright strip of a colour of its own along the street.
        shop = ((floor == 0) & (tone > 0.45) & (across > 0.1) & (across < 0.9)).astype(float)
        sign = shining(np.stack([house * 3.0, house * 0.0 + 11.0], axis=1), 1)[:, None]
        tints = np.clip(np.abs((sign + np.array([0.0, 1 / 3, 2 / 3])) % 1.0 * 6.0 - 3.0) - 1.0, 0.4, 1.0)
        goods = np.exp(4.0 * (shining(np.stack([azimuth, elevation], axis=1) * 2.5, 5, 0.7) - 0.5))
        inside += (0.7 * shop * street.lit * street.window * goods)[:, None] * tints
        return walls * light / np.pi + inside


def _street(rng: np.random.Generator, far: float) -> Street:
    return Street(
        ridge=Ridge.draw(rng, "buildings", far),
        distance=rng.uniform(12.0, 30.0) * (1.0 + 2.0 * far),
        lit=rng.uniform(0.1, 0.7),
        window=between(rng, 0.006, 0.08),
        seed=int(rng.integers(2**31)),
    )


def _lamps(rng: np.random.Generator) -> tuple[Bulb, ...]:
    """Street lamps in two rows along a street, and single ones; warm and cold."""
    turn, lamps = rng.uniform(0.0, 2.0 * np.pi), []
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    height, pitch, side = rng.uniform(3.5, 9.0), rng.uniform(8.0, 25.0), rng.uniform(4.0, 9.0)
    colour, power = np.array(LAMPS[int(rng.integers(3))]), between(rng, 0.2, 2.0)
    first = rng.uniform(0.0, pitch)
    for k in range(-2, 3):
        for row in (-1.0, 1.0):
            if rng.random() < 0.55:
                place = along * (first + k * pitch) + across * (row * side)
                lamps.append((place, height, power * colour))
    for _ in range(int(rng.integers(0, 4))):
        place = between(rng, 3.0, 25.0) * direction(rng.uniform(0.0, 360.0), 0.0)[:2]
        other = np.array(LAMPS[int(rng.integers(3))]) * between(rng, 0.02, 0.6)
        lamps.append((place, rng.uniform(2.0, 4.5), other))
    if not lamps:
        lamps.append((3.0 * along + side * across, height, power * colour))
    return tuple(
        Bulb(place=(*place, high), radius=rng.uniform(0.08, 0.25), intensity=tuple(light))
        for place, high, light in lamps
    )
