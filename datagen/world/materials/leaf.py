"""Leaves: waxy green with a net of veins, blotches, and the colours of autumn."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, mix, near, smoothstep
from datagen.world.materials.noise import fbm, worley
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

GREENS: tuple[Triple, ...] = (
    (0.07, 0.14, 0.03),
    (0.11, 0.19, 0.045),
    (0.04, 0.09, 0.035),
    (0.16, 0.21, 0.09),
)
AUTUMN: tuple[Triple, ...] = ((0.48, 0.26, 0.03), (0.40, 0.09, 0.03), (0.24, 0.11, 0.04))


class LeafSpec(Solid):
    """Leaves.

    Attributes:
        green, turning: colours of its healthy and of its ageing parts.
        age: share of the latter.
        vein: distance of the veins, world units.
        roughness: of the wax.
    """

    family: Literal["leaf"] = "leaf"
    roles = ("leaf",)
    green: Triple
    turning: Triple
    age: Number
    vein: Number
    roughness: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        return cls(
            offset=draw_offset(rng),
            green=near(rng, GREENS, 0.25),
            turning=near(rng, AUTUMN, 0.25),
            age=rng.uniform(0.0, 1.0) ** 2,
            vein=between(rng, 0.05, 0.1),
            roughness=rng.uniform(0.35, 0.65),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:  # noqa: ARG002
        cloud = fbm(points * 2.5, 4)
        net = worley(points / self.vein + 0.3 * cloud)
        vein = 1.0 - smoothstep(0.02, 0.16, net.second - net.first)
        old = 0.9 * smoothstep(0.55, -0.45, cloud + (1.3 - 2.6 * self.age))
        color = mix(column(self.green), column(self.turning), old) * (1.0 + 0.25 * cloud)
        pale = np.array([[1.6], [1.45], [1.5]], np.float32)
        color = mix(color, color * pale, 0.7 * vein) * (0.9 + 0.2 * net.random[0])
        return Look(color, self.roughness + 0.15 * old, 0.0, (0.05 * self.vein) * (net.first - vein))
