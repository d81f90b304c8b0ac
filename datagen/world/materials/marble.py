"""Marble: polished stone with veins."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, mix, near, smoothstep
from datagen.world.materials.noise import fbm, ridged
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

BODIES: tuple[tuple[Triple, Triple], ...] = (
    ((0.74, 0.73, 0.71), (0.24, 0.24, 0.26)),
    ((0.045, 0.045, 0.05), (0.62, 0.58, 0.50)),
    ((0.10, 0.20, 0.13), (0.46, 0.52, 0.44)),
    ((0.50, 0.24, 0.17), (0.66, 0.58, 0.50)),
    ((0.62, 0.53, 0.40), (0.36, 0.22, 0.10)),
    ((0.36, 0.37, 0.40), (0.68, 0.68, 0.66)),
)
"""Body and veins of Carrara, Marquina, Verde, Rosso, Siena and Bardiglio; linear."""


class MarbleSpec(Solid):
    """Marble.

    Attributes:
        body, vein: their colours.
        scale: distance of the large veins, world units.
        bend: how far they are folded.
        roughness: of the polish.
    """

    family: Literal["marble"] = "marble"
    roles = ("any", "stone", "tiles")
    body: Triple
    vein: Triple
    scale: Number
    bend: Number
    roughness: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        body, vein = BODIES[int(rng.integers(len(BODIES)))]
        return cls(
            offset=draw_offset(rng),
            body=near(rng, (body,), 0.12),
            vein=near(rng, (vein,), 0.2),
            scale=between(rng, 0.6, 1.4) if large else between(rng, 0.35, 0.9),
            bend=rng.uniform(0.4, 1.1),
            roughness=rng.uniform(0.1, 0.4),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:  # noqa: ARG002
        p = points / self.scale
        fold = fbm(p * 1.3, 3)
        bent = p + self.bend * np.stack([fold, -fold, 0.6 * fold])
        large = smoothstep(0.72, 1.0, ridged(bent, 2, 0.3))
        fine = smoothstep(0.62, 0.95, ridged(bent * 2.7 + 11.3, 3))
        vein = np.clip(large * (0.6 + 0.5 * fold) + 0.4 * fine * smoothstep(-0.2, 0.5, fold), 0.0, 1.0)
        cloud = 0.12 * smoothstep(0.0, 0.8, fold) + 0.03 * fine
        color = mix(column(self.body), column(self.vein), np.clip(0.85 * vein + cloud, 0.0, 1.0))
        return Look(color * (1.0 + 0.06 * fold), self.roughness + 0.1 * vein, 0.0, -0.0004 * vein)
