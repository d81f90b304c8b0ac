"""Rooms: walls in soft light, windows with a bright outdoors, lamps, ceiling panels, furniture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Self

import numpy as np

from datagen.world.lights.light import Light, tint
from datagen.world.lights.room import Box, Bulb, FurnishedRoom, Rectangle
from datagen.world.spec import between

SUN_TO_SKY = 40.0
"""Irradiance of a clear sun over the radiance of the sky around a window's mean direction."""


class InteriorSpec(FurnishedRoom):
    """Room at home or at work, by day or in the evening."""

    number = 6
    usual = 3
    family: Literal["interior"] = "interior"

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[Light]) -> Self:  # noqa: ARG003
        large = rng.random() < 0.35
        size = rng.uniform(7.0, 18.0, 2) if large else rng.uniform(3.2, 7.0, 2)
        size = np.append(size, rng.uniform(3.0, 6.0) if large else rng.uniform(2.4, 3.2))
        eye = size * np.append(rng.uniform(0.3, 0.7, 2), 0.0) + (0.0, 0.0, rng.uniform(1.0, 1.6))
        day = rng.random() < 0.7
        sky = rng.uniform(0.5, 1.5) * tint(rng, 0.2) if day else rng.uniform(0.001, 0.02) * tint(rng, 0.3)
        walls = rng.uniform(0.25, 0.8) * tint(rng, 0.15)
        accent = walls if rng.random() < 0.5 else rng.uniform(0.1, 0.6) * (1 + rng.uniform(-0.6, 0.6, 3))
        faces = [walls, walls, walls, accent]
        wood = rng.random() < 0.6
        faces.append(rng.uniform(0.12, 0.45) * (np.array([1.25, 0.9, 0.6]) if wood else tint(rng, 0.12)))
        faces.append(rng.uniform(0.55, 0.85) * tint(rng, 0.05))
        windows = _windows(rng, size, sky)
        lamps = not day or not windows or rng.random() < 0.4
        shining = bool(windows) and day and rng.random() < 0.5
        return cls(
            size=tuple(size),
            eye=tuple(eye),
            albedo=tuple(tuple(np.clip(face, 0.03, 0.88)) for face in faces),
            windows=windows,
            panels=_panels(rng, size) if lamps and rng.random() < 0.6 else (),
            pictures=_pictures(rng, size, windows),
            bulbs=_bulbs(rng, size, eye) if lamps or rng.random() < 0.3 else (),
            boxes=furniture(rng, size, eye),
            sun=tuple(SUN_TO_SKY * rng.uniform(0.1, 1.0) * sky * (1.1, 1.0, 0.8)) if shining else (0, 0, 0),
            sun_azimuth_deg=_through(rng, windows[0].face) if shining else 0.0,
            sun_elevation_deg=rng.uniform(12.0, 50.0),
            seed=int(rng.integers(2**31)),
        )


def _through(rng: np.random.Generator, face: int) -> float:
    """Azimuth of a sun that shines in by a face."""
    return (180.0, 0.0, 270.0, 90.0)[face] + rng.uniform(-55.0, 55.0)


def _windows(rng: np.random.Generator, size: np.ndarray, sky: np.ndarray) -> tuple[Rectangle, ...]:
    """Up to two walls with a row of windows each."""
    windows = []
    for face in rng.permutation(4)[: int(rng.choice([0, 1, 1, 1, 2]))]:
        length = size[1] if face < 2 else size[0]
        count = int(rng.integers(1, max(2, int(length / 1.6))))
        pitch = length / count
        width = pitch * rng.uniform(0.35, 0.85)
        low = rng.choice([0.08, 0.9])
        high = min(low + rng.uniform(1.1, 2.2), size[2] - 0.2)
        for k in range(count):
            left = (k + 0.5) * pitch - 0.5 * width
            windows.append(
                Rectangle(face=face, low=(left, low), high=(left + width, high), radiance=tuple(sky))
            )
    return tuple(windows)


def _panels(rng: np.random.Generator, size: np.ndarray) -> tuple[Rectangle, ...]:
    """Grid of bright rectangles in the ceiling."""
    rows, columns = (int(max(1, round(side / rng.uniform(2.0, 4.0)))) for side in size[:2])
    half = np.array([rng.uniform(0.08, 0.3), rng.uniform(0.3, 0.7)])
    light = tuple(rng.uniform(0.5, 2.5) * tint(rng, 0.2))
    panels = []
    for i in range(min(rows, 4)):
        for j in range(min(columns, 4)):
            centre = size[:2] * ((i + 0.5) / min(rows, 4), (j + 0.5) / min(columns, 4))
            low, high = np.maximum(centre - half, 0.05), np.minimum(centre + half, size[:2] - 0.05)
            panels.append(Rectangle(face=5, low=tuple(low), high=tuple(high), radiance=light))
    return tuple(panels)


def _pictures(
    rng: np.random.Generator, size: np.ndarray, windows: tuple[Rectangle, ...]
) -> tuple[Rectangle, ...]:
    """Pictures, boards and doors on walls without windows."""
    pictures = []
    for face in sorted(set(range(4)) - {window.face for window in windows}):
        length = size[1] if face < 2 else size[0]
        for k in range(int(rng.integers(0, max(2, int(length / 1.5))))):
            door = rng.random() < 0.25
            width, height = (0.9, 2.05) if door else rng.uniform(0.3, 1.1, 2)
            left = min(0.2 + 1.5 * k + rng.uniform(0.0, 0.4), length - width - 0.1)
            low = 0.0 if door else rng.uniform(1.0, 1.4)
            albedo = tuple(rng.uniform(0.08, 0.5) * (1.0 + rng.uniform(-0.35, 0.35, 3)))
            high = (left + width, min(low + height, size[2] - 0.1))
            pictures.append(Rectangle(face=face, low=(left, low), high=high, radiance=albedo))
    return tuple(pictures)


def _bulbs(rng: np.random.Generator, size: np.ndarray, eye: np.ndarray) -> tuple[Bulb, ...]:
    """Lamps that hang or stand, away from the eye."""
    warm = np.array([1.25, 0.95, 0.6]) if rng.random() < 0.6 else np.array([0.95, 1.0, 1.08])
    bulbs = []
    for _ in range(int(rng.integers(1, 6))):
        place = size * (*rng.uniform(0.08, 0.92, 2), rng.uniform(0.45, 0.92))
        if np.hypot(*(place - eye)[:2]) < 0.8:
            continue
        power = between(rng, 0.008, 0.08)
        bulbs.append(Bulb(place=tuple(place), radius=rng.uniform(0.03, 0.16), intensity=tuple(power * warm)))
    return tuple(bulbs)


def furniture(rng: np.random.Generator, size: np.ndarray, eye: np.ndarray) -> tuple[Box, ...]:
    """Blocks along the walls and tables in the room, none around the eye."""
    boxes = []
    for _ in range(int(rng.integers(3, 10))):
        half = 0.5 * rng.uniform((0.4, 0.4, 0.4), (1.8, 0.8, 2.0))
        if rng.random() < 0.5:
            half[:2] = half[1::-1]
        half = np.minimum(half, 0.3 * size)
        centre = half[:2] + rng.random(2) * (size[:2] - 2.0 * half[:2])
        side = int(rng.integers(4))
        axis, end = divmod(side, 2)
        centre[axis] = size[axis] - half[axis] - 0.01 if end else half[axis] + 0.01
        if (np.abs(centre - eye[:2]) < half[:2] + 0.5).all():
            continue
        colour = 1.0 + rng.uniform(-0.4, 0.4, 3) if rng.random() < 0.4 else np.array([1.2, 0.95, 0.7])
        albedo = tuple(np.clip(rng.uniform(0.06, 0.6) * colour, 0.03, 0.85))
        top = 2.0 * half[2]
        table = top < 1.0 and rng.random() < 0.6
        low, high = centre - half[:2], centre + half[:2]
        boxes.append(Box(low=(*low, top - 0.05 if table else 0.0), high=(*high, top), albedo=albedo))
        if table:
            corners = [(x, y) for x in (low[0], high[0] - 0.05) for y in (low[1], high[1] - 0.05)]
            boxes += [
                Box(low=(x, y, 0.0), high=(x + 0.05, y + 0.05, top - 0.05), albedo=albedo) for x, y in corners
            ]
    return tuple(boxes)
