"""Soft boxes around a dim surround."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Self

import numpy as np

from datagen.world.lights.light import Light, direction, edge, tint
from datagen.world.spec import Number, Spec, Triple


class Panel(Spec):
    """A soft box at infinity: centre direction, half sizes and edge softness in degrees, linear radiance."""

    azimuth_deg: Number
    elevation_deg: Number
    roll_deg: Number
    half_width_deg: Number
    half_height_deg: Number
    softness_deg: Number
    radiance: Triple


class StudioSpec(Light):
    """Soft boxes on a surround that fades from ``floor`` below to ``ceiling`` above (linear radiance)."""

    number = 1
    usual = 2
    family: Literal["studio"] = "studio"
    panels: tuple[Panel, ...]
    floor: Triple
    ceiling: Triple

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[Light]) -> Self:  # noqa: ARG003
        panels = []
        for k in range(int(rng.integers(1, 5))):
            power = rng.uniform(10.0, 25.0) if k == 0 else rng.uniform(2.0, 12.0)
            panels.append(
                Panel(
                    azimuth_deg=rng.uniform(0.0, 360.0),
                    # The key light stands high enough to light the floor; fills may be anywhere above it.
                    elevation_deg=rng.uniform(35.0, 75.0) if k == 0 else rng.uniform(5.0, 80.0),
                    roll_deg=rng.uniform(0.0, 180.0),
                    half_width_deg=rng.uniform(6.0, 20.0),
                    half_height_deg=rng.uniform(6.0, 20.0),
                    softness_deg=rng.uniform(1.0, 4.0),
                    radiance=tuple(power * tint(rng, 0.35)),
                )
            )
        ambient = rng.uniform(0.02, 0.15)
        return cls(
            panels=tuple(panels),
            floor=tuple(ambient * rng.uniform(0.3, 1.0) * tint(rng, 0.2)),
            ceiling=tuple(ambient * tint(rng, 0.2)),
        )

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        up = 0.5 + 0.5 * directions[:, 2:]
        image = np.asarray(self.floor) * (1.0 - up) + np.asarray(self.ceiling) * up
        for panel in self.panels:
            centre = direction(panel.azimuth_deg, panel.elevation_deg)
            right = np.cross((0.0, 0.0, 1.0), centre)
            right /= np.linalg.norm(right)
            roll = np.radians(panel.roll_deg)
            above = np.cross(centre, right)
            right, above = (
                np.cos(roll) * right + np.sin(roll) * above,
                np.cos(roll) * above - np.sin(roll) * right,
            )
            depth = directions @ centre
            x = np.degrees(np.arctan2(np.abs(directions @ right), depth))
            y = np.degrees(np.arctan2(np.abs(directions @ above), depth))
            inside = edge(panel.half_width_deg - x, panel.softness_deg) * edge(
                panel.half_height_deg - y, panel.softness_deg
            )
            image = image * (1.0 - inside[:, None]) + inside[:, None] * np.asarray(panel.radiance)
        return image
