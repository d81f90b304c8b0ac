"""Box room seen from inside: what a direction meets, and the light that falls there.

Metres; the corner of the room is the origin, z up. Direct light comes from rectangles and small lamps without
shadows but the sun's; light that bounces is that of an integrating sphere of the room's area and mean albedo.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.lights.directions import smoothstep
from datagen.spec import Number, Spec, Triple

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
    """Share (N,) of bounced light that corners, and things on the floor, leave."""
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
