"""Brickwork in running bond: fired clay of many shades, mortar set back."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, laid, mix, near, smoothstep
from datagen.world.materials.noise import cell_random, fbm
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

CLAYS: tuple[Triple, ...] = (
    (0.34, 0.11, 0.06),
    (0.42, 0.20, 0.11),
    (0.24, 0.09, 0.06),
    (0.50, 0.38, 0.22),
    (0.16, 0.12, 0.10),
    (0.55, 0.52, 0.48),
)
"""Red, orange, dark red, yellow, blue-black and whitewashed brick; linear."""

MORTARS: tuple[Triple, ...] = ((0.42, 0.40, 0.36), (0.28, 0.26, 0.24), (0.55, 0.52, 0.47))


class BrickSpec(Solid):
    """Brickwork.

    Attributes:
        clay, mortar: their colours.
        length, height: of a brick with its joint, world units; a course is ``height`` high.
        joint: width of the mortar, world units.
        variation: how far bricks differ in brightness.
    """

    family: Literal["brick"] = "brick"
    roles = ("any", "brick")
    clay: Triple
    mortar: Triple
    length: Number
    height: Number
    joint: Number
    variation: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        height = between(rng, 0.10, 0.22) if large else between(rng, 0.08, 0.16)
        return cls(
            offset=draw_offset(rng),
            clay=near(rng, CLAYS, 0.2),
            mortar=near(rng, MORTARS, 0.15),
            length=height * rng.uniform(2.3, 3.3),
            height=height,
            joint=height * rng.uniform(0.1, 0.18),
            variation=rng.uniform(0.2, 0.6),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:
        u, v, side = laid(points, normals)
        rough = fbm(points * 9.0, 3)
        u, v = u + 0.006 * rough, v + 0.006 * rough
        row = np.floor(v / self.height)
        across = u / self.length + 0.5 * (row % 2.0)
        brick = np.floor(across)
        r = cell_random(brick, row, side)
        edge = np.minimum(
            (0.5 - np.abs(across - brick - 0.5)) * self.length,
            (0.5 - np.abs(v / self.height - row - 0.5)) * self.height,
        )
        solid = smoothstep(0.35 * self.joint, 0.75 * self.joint, edge)
        stain = fbm(points * 2.2, 3)
        shade = np.exp(self.variation * (2.0 * r[0] - 1.0)) * (1.0 + 0.18 * rough + 0.15 * stain)
        burnt = np.array([[0.55], [0.62], [0.75]], np.float32)
        clay = column(self.clay) * shade * np.where(r[1] > 0.85, burnt, 1.0)
        mortar = column(self.mortar) * (1.0 + 0.25 * rough + 0.15 * stain)
        # A bed of mortar, and each brick a little proud of the next.
        height = solid * (0.35 * self.joint + 0.15 * self.joint * r[2]) + 0.12 * self.joint * rough
        return Look(mix(mortar, clay, solid), 0.93 - 0.14 * solid * r[3] + 0.04 * rough, 0.0, height)
