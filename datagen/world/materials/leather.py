"""Leather: creased cells, wrinkles, and a polish where it was rubbed."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, mix, near, smoothstep
from datagen.world.materials.noise import fbm, ridged, worley
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

HIDES: tuple[Triple, ...] = (
    (0.17, 0.075, 0.035),
    (0.035, 0.032, 0.032),
    (0.32, 0.16, 0.07),
    (0.25, 0.04, 0.035),
    (0.48, 0.38, 0.27),
    (0.07, 0.10, 0.085),
)
"""Brown, black, tan, oxblood, cream and green; linear."""


class LeatherSpec(Solid):
    """Leather.

    Attributes:
        color: linear.
        grain: size of its cells, world units.
        roughness: of its grain.
        worn: how far crests are rubbed paler.
    """

    family: Literal["leather"] = "leather"
    roles = ("any", "leather", "fabric")
    color: Triple
    grain: Number
    roughness: Number
    worn: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        return cls(
            offset=draw_offset(rng),
            color=near(rng, HIDES, 0.25),
            grain=between(rng, 0.03, 0.07),
            roughness=rng.uniform(0.35, 0.6),
            worn=rng.uniform(0.0, 0.8),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:  # noqa: ARG002
        cloud = fbm(points * 1.8, 3)
        cells = worley(points / self.grain + 0.4 * cloud)
        crease = 1.0 - smoothstep(0.02, 0.28, cells.second - cells.first)
        wrinkle = smoothstep(0.6, 0.95, ridged(points * 2.6, 2))
        rubbed = self.worn * smoothstep(0.0, 0.7, cloud) * (1.0 - crease)
        color = column(self.color) * (
            1.0 + 0.2 * cloud - 0.4 * crease - 0.3 * wrinkle + 0.1 * cells.random[0]
        )
        color = mix(color, 1.5 * color + 0.03, rubbed)
        rough = self.roughness + 0.18 * crease - 0.12 * rubbed + 0.1 * wrinkle
        height = (-0.16 * self.grain) * crease - 0.008 * wrinkle
        return Look(color, rough, 0.0, height)
