"""Coloured light: stages, clubs and studios with neon, screens and tinted soft boxes."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import Literal, Self

import numpy as np

from datagen.world.lights.interior import furniture
from datagen.world.lights.light import Light
from datagen.world.lights.room import Bulb, FurnishedRoom, Rectangle
from datagen.world.spec import between


class ColouredSpec(FurnishedRoom):
    """Dark room under lights of two or three strong hues."""

    number = 8
    usual = 1
    family: Literal["coloured"] = "coloured"

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[Light]) -> Self:  # noqa: ARG003
        size = np.append(rng.uniform(4.0, 14.0, 2), rng.uniform(2.8, 6.0))
        eye = size * np.append(rng.uniform(0.3, 0.7, 2), 0.0) + (0.0, 0.0, rng.uniform(1.0, 1.6))
        first = rng.random()
        hues = (first + np.array([0.0, rng.uniform(0.25, 0.6), rng.uniform(0.0, 1.0)])) % 1.0
        walls = rng.uniform(0.05, 0.55) * np.ones(3)
        faces = [walls * rng.uniform(0.6, 1.2) for _ in range(4)]
        faces += [rng.uniform(0.04, 0.4) * np.ones(3), rng.uniform(0.04, 0.6) * np.ones(3)]
        shapes = ("box", "box", "tube", "tube", "screen")
        chosen = [shapes[int(rng.integers(len(shapes)))] for _ in range(int(rng.integers(2, 8)))]
        rectangles = [(shape, _rectangle(rng, size, shape, hues)) for shape in chosen]
        return cls(
            size=tuple(size),
            eye=tuple(eye),
            albedo=tuple(tuple(face) for face in faces),
            windows=(),
            panels=tuple(each for shape, each in rectangles if shape != "screen"),
            screens=tuple(each for shape, each in rectangles if shape == "screen"),
            pictures=(),
            bulbs=_spots(rng, size, eye, hues),
            boxes=furniture(rng, size, eye),
            sun=(0, 0, 0),
            sun_azimuth_deg=0.0,
            sun_elevation_deg=0.0,
            seed=int(rng.integers(2**31)),
        )


def _colour(rng: np.random.Generator, hues: np.ndarray) -> np.ndarray:
    """One of the hues (3,) linear, strongly tinted or, seldom, nearly white."""
    saturation = rng.uniform(0.75, 0.98) if rng.random() < 0.85 else rng.uniform(0.0, 0.3)
    hue = hues[int(rng.integers(len(hues)))] + rng.uniform(-0.03, 0.03)
    return np.asarray(colorsys.hsv_to_rgb(hue % 1.0, saturation, 1.0))


def _rectangle(rng: np.random.Generator, size: np.ndarray, shape: str, hues: np.ndarray) -> Rectangle:
    """Soft box, neon tube or screen somewhere in the walls or the ceiling."""
    face = int(rng.choice([0, 1, 2, 3, 5]))
    room = np.delete(size, face // 2)
    if shape == "tube":
        extent = np.array([rng.uniform(0.6, 3.0), rng.uniform(0.04, 0.1)])
        extent = extent if rng.random() < 0.6 else extent[::-1]
        power = rng.uniform(2.0, 12.0)
    elif shape == "screen":
        extent, power = rng.uniform((1.5, 1.0), (5.0, 2.5)), rng.uniform(0.15, 0.6)
    else:
        extent, power = rng.uniform(0.4, 1.8, 2), rng.uniform(0.4, 3.0)
    extent = np.minimum(extent, 0.9 * room)
    low = rng.random(2) * (room - extent)
    if face < 4:  # nothing shines from the foot of a wall
        low[1] = max(low[1], min(0.6, room[1] - extent[1]))
    return Rectangle(
        face=face, low=tuple(low), high=tuple(low + extent), radiance=tuple(power * _colour(rng, hues))
    )


def _spots(rng: np.random.Generator, size: np.ndarray, eye: np.ndarray, hues: np.ndarray) -> tuple[Bulb, ...]:
    """Spotlights under the ceiling, away from the eye."""
    spots = []
    for _ in range(int(rng.integers(0, 7))):
        place = size * (*rng.uniform(0.06, 0.94, 2), rng.uniform(0.75, 0.95))
        if np.hypot(*(place - eye)[:2]) < 0.8:
            continue
        power = between(rng, 0.02, 0.5)
        intensity = tuple(power * _colour(rng, hues))
        spots.append(Bulb(place=tuple(place), radius=rng.uniform(0.05, 0.15), intensity=intensity))
    return tuple(spots)
