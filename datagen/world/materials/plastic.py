"""Moulded plastic: one colour, a fine grain, and scuffs."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, mix, near, smoothstep
from datagen.world.materials.noise import fbm, gradient_noise
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

COLORS: tuple[Triple, ...] = (
    (0.55, 0.04, 0.03),
    (0.04, 0.14, 0.46),
    (0.70, 0.46, 0.03),
    (0.05, 0.32, 0.10),
    (0.72, 0.72, 0.70),
    (0.035, 0.035, 0.04),
    (0.66, 0.20, 0.03),
    (0.42, 0.42, 0.43),
    (0.10, 0.40, 0.42),
    (0.48, 0.12, 0.28),
)
"""Red, blue, yellow, green, white, black, orange, grey, turquoise and pink; linear."""


class PlasticSpec(Solid):
    """Moulded plastic.

    Attributes:
        color: linear.
        roughness: where it is not scuffed.
        grain: size of the mould's grain, world units.
        relief: its height, world units.
        scuffed: share that hands and floors have dulled.
    """

    family: Literal["plastic"] = "plastic"
    roles = ("any", "plastic")
    color: Triple
    roughness: Number
    grain: Number
    relief: Number
    scuffed: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        grained = rng.random() < 0.5
        return cls(
            offset=draw_offset(rng),
            color=near(rng, COLORS, 0.25),
            roughness=rng.uniform(0.3, 0.65) if grained else rng.uniform(0.12, 0.4),
            grain=between(rng, 0.03, 0.06),
            relief=between(rng, 0.0008, 0.003) if grained else 0.0,
            scuffed=rng.uniform(0.0, 0.7),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:  # noqa: ARG002
        cloud = fbm(points * 2.0, 3)
        scuff = smoothstep(0.1, 0.6, cloud + (self.scuffed - 0.5))
        scuff = scuff * (0.5 + 0.5 * gradient_noise(points * 16.0))
        color = column(self.color) * (1.0 + 0.03 * cloud)
        grey = 0.28
        height: np.ndarray | float = 0.0
        if self.relief:
            height = self.relief * gradient_noise(points / self.grain)
        return Look(
            mix(color, 0.8 * color + 0.2 * grey, 0.5 * scuff), self.roughness + 0.3 * scuff, 0.0, height
        )
