"""Furnished room as a light: what its walls, windows, lamps and things send to the eye."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from pydantic import Field

from datagen.lights.directions import direction, smoothstep
from datagen.lights.discs import Disc
from datagen.lights.light import Light
from datagen.lights.noise import Fractal
from datagen.lights.room import (
    Box,
    Bulb,
    Hits,
    Rectangle,
    bounced,
    bulbs_light,
    cast,
    direct,
    glazed,
    nearness,
    sunlit,
)
from datagen.spec import Number, Triple

PLANK = 0.14
"""Metres of a board's or a tile's width."""


class FurnishedRoom(Light):
    """Room, lit by its windows and lamps. Metres; linear radiance, where the sky outdoors has about one.

    Attributes:
        size: of the room in x, y, z.
        eye: where the map is seen from.
        albedo: of the six faces, numbered as in :class:`Rectangle`.
        windows, panels, screens, pictures: in the faces; a picture carries an albedo, a screen a coloured
            pattern.
        sun: its irradiance on a plane facing it, which falls in by windows; azimuth and elevation in degrees.
    """

    supersamples = 2
    size: Triple
    eye: Triple
    albedo: tuple[Triple, ...] = Field(min_length=6, max_length=6)
    windows: tuple[Rectangle, ...]
    panels: tuple[Rectangle, ...]
    screens: tuple[Rectangle, ...] = ()
    pictures: tuple[Rectangle, ...]
    bulbs: tuple[Bulb, ...]
    boxes: tuple[Box, ...]
    sun: Triple
    sun_azimuth_deg: Number
    sun_elevation_deg: Number
    seed: int

    @cached_property
    def _room(self) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.size), np.asarray(self.eye)

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        size, eye = self._room
        hits = cast(size, self.boxes, eye, directions)
        sun = direction(self.sun_azimuth_deg, self.sun_elevation_deg)
        irradiance = direct(hits, self._shining(), size) + bulbs_light(hits, self.bulbs)
        if any(self.sun):
            irradiance += sunlit(hits, sun, self.windows, size, self.boxes)[:, None] * np.asarray(self.sun)
        mean = np.clip(np.asarray(self.albedo).mean(axis=0), 0.05, 0.85)
        irradiance += nearness(hits, size, self.boxes)[:, None] * bounced(self._flux(sun), size, mean)
        image = self._albedo(hits) * irradiance / np.pi
        for window in self.windows:
            there = np.flatnonzero(hits.thing == window.face)
            glass = glazed(window.place(hits.points[there]))[:, None]
            outdoors = self._outdoors(directions[there], np.asarray(window.radiance))
            inside = self._frame(window, hits.points[there])[:, None]
            image[there] = image[there] * (1.0 - 0.3 * inside) * (1.0 - glass) + outdoors * glass
        for panel in self.panels:
            there = np.flatnonzero(hits.thing == panel.face)
            within = _inside(panel, hits.points[there])
            image[there[within]] = panel.radiance
        for number, screen in enumerate(self.screens):
            there = np.flatnonzero(hits.thing == screen.face)
            there = there[_inside(screen, hits.points[there])]
            pattern = self._paint(f"screen {number}", screen.place(hits.points[there]), 4.0)
            image[there] = np.asarray(screen.radiance) * pattern
        return image

    def discs(self) -> Sequence[Disc]:
        _, eye = self._room
        found = []
        for bulb in self.bulbs:
            to = np.asarray(bulb.place) - eye
            distance = float(np.linalg.norm(to))
            width = 2.0 * np.degrees(np.arcsin(min(bulb.radius / distance, 1.0)))
            found.append(Disc(to / distance, float(width), np.asarray(bulb.intensity) / distance**2))
        return found

    def _shining(self) -> tuple[Rectangle, ...]:
        return self.windows + self.panels + self.screens

    def _flux(self, sun: np.ndarray) -> np.ndarray:
        """Light (3,) that enters the room: radiance x pi x area, intensity x 4 pi, and the sun's."""
        flux = sum((np.pi * r.area() * np.asarray(r.radiance) for r in self._shining()), np.zeros(3))
        flux = flux + sum((4 * np.pi * np.asarray(b.intensity) for b in self.bulbs), np.zeros(3))
        for window in self.windows:
            axis, end = divmod(window.face, 2)
            flux = flux + np.asarray(self.sun) * window.area() * max(sun[axis] * (2 * end - 1), 0.0)
        return flux

    def _albedo(self, hits: Hits) -> np.ndarray:
        """Linear albedo (N, 3): boards on the floor, plaster, pictures, furniture."""
        table = np.array([*self.albedo, *(box.albedo for box in self.boxes)], np.float32)
        albedo = table[hits.thing]
        axes = np.array([[1, 2], [0, 2], [0, 1]])[np.abs(hits.normals).argmax(axis=1)]
        plane = np.take_along_axis(hits.points, axes, axis=1)
        grain = Fractal(self.seed, "grain")(plane * 2.5 + hits.thing[:, None] * 31.7, 6, 0.75)
        rough = np.array([0.5] * 4 + [1.3, 0.25] + [1.0] * len(self.boxes), np.float32)[hits.thing]
        albedo *= np.exp(rough * (grain - 0.5))[:, None]
        floor = np.flatnonzero(hits.thing == 4)
        width = PLANK * (1.0 + self.seed % 5)
        board = np.floor(plane[floor, 0] / width)
        along = plane[floor, 1] / (6.0 * width) + board * 0.37
        tone = Fractal(self.seed, "boards")(np.stack([board * 3.0, np.floor(along) * 3.0], axis=1), 1)
        seam = smoothstep(np.abs(plane[floor, 0] / width - board - 0.5), 0.47, 0.5)
        albedo[floor] *= ((0.65 + 0.7 * tone) * (1.0 - 0.6 * seam))[:, None]
        skirting = (hits.thing < 4) & (hits.points[:, 2] < 0.09)
        albedo[skirting] = 0.5 * albedo[skirting] + 0.2
        for number, picture in enumerate(self.pictures):
            there = np.flatnonzero(hits.thing == picture.face)
            there = there[_inside(picture, hits.points[there])]
            place = picture.place(hits.points[there])
            albedo[there] = np.asarray(picture.radiance) * self._paint(f"picture {number}", place, 3.5)
            border = np.minimum(place, 1.0 - place).min(axis=1) < 0.04
            albedo[there[border]] = 0.06
        return np.clip(albedo, 0.02, 0.9)

    def _paint(self, name: str, place: np.ndarray, strength: float) -> np.ndarray:
        """Pattern (N, 3) of mean about one at places (N, 2) in units of a rectangle."""
        fractal = Fractal(self.seed, name)
        hue = np.stack([fractal(place * 4.0 + 50.0 * channel, 5, 0.6) for channel in range(3)], axis=1)
        return np.exp(strength * (hue - 0.5))

    def _outdoors(self, directions: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Sky above a ragged horizon, and what stands before it, of the ``mean`` radiance given."""
        angles = np.degrees(
            np.stack([np.arctan2(directions[:, 1], directions[:, 0]), directions[:, 2]], axis=1)
        )
        leaves = Fractal(self.seed, "outdoors")
        skyline = 14.0 * (leaves(angles * (0.06, 0.0), 6) - 0.4)
        texture = np.exp(2.5 * (leaves(angles * 0.4, 6, 0.7) - 0.5))[:, None]
        above = smoothstep(angles[:, 1] - skyline, -1.0, 1.0)[:, None]
        dim = np.array([0.22, 0.25, 0.16]) * texture
        sky = 1.15 + 0.5 * (leaves(angles * 0.05 + 9.0, 5)[:, None] - 0.5)
        return mean * (sky * above + dim * (1.0 - above))

    def _frame(self, window: Rectangle, points: np.ndarray) -> np.ndarray:
        place = window.place(points)
        return ((place > -0.03) & (place < 1.03)).all(axis=1).astype(float)


def _inside(rectangle: Rectangle, points: np.ndarray) -> np.ndarray:
    place = rectangle.place(points)
    return np.all((place > 0.0) & (place < 1.0), axis=1)
