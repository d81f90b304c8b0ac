"""Plaster and paint: trowelled or rolled, stained, and worn down to what is under it."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, mix, near, smoothstep
from datagen.world.materials.noise import fbm, gradient_noise
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

PAINTS: tuple[Triple, ...] = (
    (0.74, 0.72, 0.67),
    (0.66, 0.58, 0.44),
    (0.44, 0.52, 0.50),
    (0.22, 0.33, 0.42),
    (0.52, 0.28, 0.18),
    (0.36, 0.42, 0.26),
    (0.62, 0.46, 0.14),
    (0.42, 0.41, 0.40),
)
"""White, cream, sage, blue, terracotta, green, ochre and grey; linear."""

UNDER: tuple[Triple, ...] = ((0.48, 0.44, 0.38), (0.30, 0.27, 0.24), (0.33, 0.20, 0.10), (0.62, 0.60, 0.55))
"""Plaster, cement, wood and an older coat."""


class PaintSpec(Solid):
    """Plaster or paint.

    Attributes:
        paint, under: colours of the coat and of what shows through it.
        bumps: size of the texture that trowel or roller left, world units.
        relief: its height, world units.
        wear: share that is chipped off, about.
        dirt: strength of stains.
        roughness: of the coat.
    """

    family: Literal["paint"] = "paint"
    roles = ("any", "plaster")
    paint: Triple
    under: Triple
    bumps: Number
    relief: Number
    wear: Number
    dirt: Number
    roughness: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        worn = rng.random() < 0.5
        return cls(
            offset=draw_offset(rng),
            paint=near(rng, PAINTS, 0.15),
            under=near(rng, UNDER, 0.2),
            bumps=between(rng, 0.05, 0.2),
            relief=between(rng, 0.0015, 0.008),
            wear=rng.uniform(0.1, 0.45) if worn else 0.0,
            dirt=rng.uniform(0.0, 0.35),
            roughness=rng.uniform(0.45, 0.9),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:  # noqa: ARG002
        bumps = fbm(points / self.bumps, 3)
        cloud = fbm(points * 1.4 + 3.0, 4)
        x, y, z = points
        # Stains run down.
        run = gradient_noise(np.stack([5.0 * x, 5.0 * y, 0.6 * z])) * smoothstep(-0.2, 0.5, cloud)
        stain = self.dirt * np.clip(0.5 + 0.8 * run + 0.5 * cloud, 0.0, 1.0)
        grime = np.array([[0.55], [0.47], [0.38]], np.float32)
        coat = column(self.paint) * (1.0 + 0.05 * bumps + 0.05 * cloud)
        coat = mix(coat, coat * grime, stain)
        rough = self.roughness + 0.08 * bumps + 0.2 * stain
        height = self.relief * bumps
        if self.wear:
            level = fbm(points * 2.3, 5, 0.6) + 0.12 * bumps + (1.6 * self.wear - 0.95)
            bare = smoothstep(-0.015, 0.015, level)
            rim = smoothstep(-0.06, -0.015, level) * (1.0 - bare)
            coat = mix(coat * (1.0 + 0.12 * rim), column(self.under) * (1.0 + 0.3 * bumps), bare)
            rough = mix(rough, 0.9, bare)
            height = height - 0.01 * bare + 0.003 * rim
        return Look(coat, rough, 0.0, height)
