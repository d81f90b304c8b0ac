"""Box room as a light, seen from inside: ray casting, and irradiance on its surfaces.

Metres; the corner of the room is the origin, z up. Direct light comes from rectangles and small lamps without
shadows but the sun's; light that bounces is that of an integrating sphere of the room's area and mean albedo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydantic import Field

from datagen.world.lights.light import Disc, Light, direction, smoothstep
from datagen.world.lights.noise import Fractal
from datagen.world.spec import Number, Spec, Triple

CORNER = 0.35
"""Metres over which a corner or a thing on the floor darkens what is near it."""

FEW = 4
"""Rectangles that are worth several patches each."""


class Rectangle(Spec):
    """Rectangle in a face of the room.

    Attributes:
        face: 0 and 1 at x = 0 and its end, 2 and 3 in y, 4 floor, 5 ceiling.
        low, high: corners in the face's two axes, in the order of x, y, z.
        radiance: linear; mean of a window's outdoors, constant over a lamp's panel, albedo of a picture.
    """

    face: int
    low: tuple[Number, Number]
    high: tuple[Number, Number]
    radiance: Triple

    def place(self, points: np.ndarray) -> np.ndarray:
        """Coordinates (N, 2) in units of the rectangle of points (N, 3) in its face: inside is 0 to 1."""
        axes = [axis for axis in range(3) if axis != self.face // 2]
        low, high = np.asarray(self.low, np.float32), np.asarray(self.high, np.float32)
        return (points[:, axes] - low) / (high - low)

    def area(self) -> float:
        """Square metres."""
        return (self.high[0] - self.low[0]) * (self.high[1] - self.low[1])


class Box(Spec):
    """Piece of furniture: a block between two corners."""

    low: Triple
    high: Triple
    albedo: Triple


class Bulb(Spec):
    """Small lamp: its place, its radius, metres, and its linear intensity (radiance times square metres)."""

    place: Triple
    radius: Number
    intensity: Triple


@dataclass(frozen=True)
class Hits:
    """Ends of rays.

    Attributes:
        points: (N, 3) metres.
        normals: (N, 3), unit.
        thing: (N,) face of the room (0 to 5), or 6 + number of the box.
    """

    points: np.ndarray
    normals: np.ndarray
    thing: np.ndarray


def cast(size: np.ndarray, boxes: tuple[Box, ...], eye: np.ndarray, directions: np.ndarray) -> Hits:
    """First surface in each of the directions (N, 3) from ``eye``, inside the room and outside of boxes."""
    d = np.where(np.abs(directions) < 1e-6, 1e-6, directions).astype(np.float32)
    size, eye = size.astype(np.float32), eye.astype(np.float32)
    inverse = 1.0 / d
    reach = np.where(d > 0, size - eye, -eye) * inverse
    axis = reach.argmin(axis=1)
    row = np.arange(len(d))
    distance = reach[row, axis]
    thing = 2 * axis + (d[row, axis] > 0)
    for number, box in enumerate(boxes):
        low, high = np.asarray(box.low, np.float32) - eye, np.asarray(box.high, np.float32) - eye
        centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
        away = float(np.linalg.norm(centre))
        cone = np.sqrt(1.0 - (radius / away) ** 2) if away > radius else -1.0
        some = np.flatnonzero(d @ (centre / np.float32(away)) > cone - 1e-4)
        a, b = low * inverse[some], high * inverse[some]
        near, far = np.minimum(a, b), np.maximum(a, b).min(axis=1)
        enter = near.max(axis=1)
        met = (enter < far) & (enter > 0) & (enter < distance[some])
        index = some[met]
        distance[index], thing[index], axis[index] = enter[met], 6 + number, near[met].argmax(axis=1)
    normals = np.zeros_like(d)
    normals[row, axis] = -np.sign(d[row, axis])
    return Hits(eye + distance[:, None] * d, normals, thing)


def direct(hits: Hits, rectangles: tuple[Rectangle, ...], size: np.ndarray) -> np.ndarray:
    """Irradiance (N, 3) from rectangles that shine: patches, area x cosines over distance squared.

    Where there are few, each is 2 x 2 patches; many are far or small.
    """
    total = np.zeros_like(hits.points)
    shares = (0.25, 0.75) if len(rectangles) <= FEW else (0.5,)
    for rectangle in rectangles:
        axis, end = divmod(rectangle.face, 2)
        facing = np.zeros(3, np.float32)
        facing[axis] = 1.0 - 2.0 * end
        patch = np.float32(rectangle.area() / len(shares) ** 2)
        sum_of_factors = np.zeros(len(total), np.float32)
        for u in shares:
            for v in shares:
                inner = [
                    low + share * (high - low)
                    for share, low, high in zip((u, v), rectangle.low, rectangle.high)
                ]
                inner.insert(axis, float(size[axis]) * end)
                sum_of_factors += _factor(hits, np.asarray(inner, np.float32), facing, patch)
        total += sum_of_factors[:, None] * np.asarray(rectangle.radiance, np.float32)
    return total


def _factor(hits: Hits, place: np.ndarray, facing: np.ndarray, area: np.float32) -> np.ndarray:
    """Irradiance (N,) per radiance of a small patch; bounded where a surface comes near to it."""
    to = place - hits.points
    squared = np.einsum("ij,ij->i", to, to)
    here = np.maximum(np.einsum("ij,ij->i", to, hits.normals), 0)
    there = np.maximum(-(to @ facing), 0)
    squared = np.maximum(squared, np.float32(1e-12))  # a point of the patch itself
    return area * here * there / (squared * (squared + area / np.float32(np.pi)))


def bulbs_light(hits: Hits, bulbs: tuple[Bulb, ...]) -> np.ndarray:
    """Irradiance (N, 3) from small lamps, intensity x cosine over distance squared."""
    total = np.zeros_like(hits.points)
    for bulb in bulbs:
        to = np.asarray(bulb.place, np.float32) - hits.points
        squared = np.maximum(np.einsum("ij,ij->i", to, to), np.float32(bulb.radius**2))
        cosine = np.maximum(np.einsum("ij,ij->i", to, hits.normals), 0) / np.sqrt(squared)
        total += (cosine / squared)[:, None] * np.asarray(bulb.intensity, np.float32)
    return total


def bounced(flux: np.ndarray, size: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Irradiance (3,) by light that bounced: flux x albedo / ((1 - albedo) x area) (integrating sphere)."""
    x, y, z = size
    return flux * albedo / ((1.0 - albedo) * 2.0 * (x * y + y * z + z * x))


def nearness(hits: Hits, size: np.ndarray, boxes: tuple[Box, ...]) -> np.ndarray:
    """Return the share (N,) of bounced light that reaches places near corners and furniture."""
    gap = np.minimum(hits.points, size.astype(np.float32) - hits.points)
    dark = np.where(hits.normals != 0, 0.0, np.exp(-np.maximum(gap, 0.0) / CORNER)).sum(axis=1)
    share = 1.0 - 0.3 * np.minimum(dark, 1.5)
    floor = np.flatnonzero(hits.thing == 4)
    for box in boxes:
        if box.low[2] > 1.0:
            continue
        outside = np.maximum(
            np.asarray(box.low[:2]) - hits.points[floor, :2],
            hits.points[floor, :2] - np.asarray(box.high[:2]),
        )
        away = np.linalg.norm(np.maximum(outside, 0.0), axis=1) + box.low[2]
        share[floor] *= 1.0 - 0.6 * np.exp(-away / CORNER)
    return share


def sunlit(
    hits: Hits, sun: np.ndarray, windows: tuple[Rectangle, ...], size: np.ndarray, boxes: tuple[Box, ...]
) -> np.ndarray:
    """Cosine (N,) at which the sun's rays fall through windows, 0 in the shade; ``sun`` is a unit vector."""
    cosine = np.maximum(hits.normals @ sun.astype(np.float32), 0)
    lit = np.zeros_like(cosine)
    for window in windows:
        axis, end = divmod(window.face, 2)
        if (sun[axis] > 0) != (end == 1) or abs(sun[axis]) < 1e-3:
            continue
        some = np.flatnonzero(cosine > 0)
        distance = (size[axis] * end - hits.points[some, axis]) / sun[axis]
        through = hits.points[some] + distance[:, None] * sun
        lit[some] = np.maximum(lit[some], glazed(window.place(through)) * (distance > 1e-3))
    beam = np.flatnonzero(lit > 0)
    inverse = 1.0 / np.where(np.abs(sun) < 1e-6, 1e-6, sun)
    for box in boxes:
        start = hits.points[beam] + 1e-3 * hits.normals[beam]
        a, b = (np.asarray(box.low) - start) * inverse, (np.asarray(box.high) - start) * inverse
        enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        lit[beam[(enter < leave) & (leave > 0)]] = 0.0
    return lit * cosine


def glazed(place: np.ndarray) -> np.ndarray:
    """1 where a window is glass, 0 on its frame and bars and outside, for places (N, 2) in its units."""
    bars = np.minimum(np.abs(place - 0.5), np.minimum(np.abs(place), np.abs(place - 1.0)))
    inside = ((place > 0.0) & (place < 1.0)).all(axis=1)
    return smoothstep(bars.min(axis=1), 0.015, 0.03) * inside


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
