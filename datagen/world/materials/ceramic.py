"""Glazed ceramic: a glaze that pools and speckles, painted bands, and crackle."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, mix, near, smoothstep
from datagen.world.materials.noise import fbm, worley
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

GLAZES: tuple[Triple, ...] = (
    (0.74, 0.73, 0.70),
    (0.06, 0.12, 0.30),
    (0.30, 0.42, 0.36),
    (0.34, 0.14, 0.05),
    (0.05, 0.05, 0.055),
    (0.48, 0.10, 0.06),
    (0.10, 0.26, 0.28),
    (0.62, 0.52, 0.32),
)
"""Porcelain, cobalt, celadon, tenmoku, black, oxblood, teal and cream; linear."""


class CeramicSpec(Solid):
    """Glazed ceramic; it was turned about z.

    Attributes:
        glaze, second: colours of the glaze, and of its bands or speckles.
        decor: what is on it.
        scale: distance of bands or cracks, world units.
        roughness: of the glaze.
    """

    family: Literal["ceramic"] = "ceramic"
    roles = ("any", "ceramic")
    glaze: Triple
    second: Triple
    decor: Literal["none", "bands", "speckles", "crackle", "drips"]
    scale: Number
    roughness: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        decors = ("none", "bands", "speckles", "crackle", "drips")
        return cls(
            offset=draw_offset(rng),
            glaze=near(rng, GLAZES, 0.2),
            second=near(rng, GLAZES, 0.2),
            decor=decors[int(rng.integers(len(decors)))],
            scale=between(rng, 0.1, 0.3),
            roughness=rng.uniform(0.1, 0.3),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:  # noqa: ARG002
        pool = fbm(points * 2.2, 3)
        glaze = column(self.glaze) * (1.0 + 0.14 * pool)
        second = column(self.second)
        z = points[2] / self.scale
        rough = self.roughness + 0.04 * pool
        height: np.ndarray = 0.003 * pool
        if self.decor == "bands":
            wobble = z + 0.05 * pool
            place = wobble - 3.0 * np.floor(wobble / 3.0)
            band = smoothstep(0.04, 0.0, np.abs(place - 1.0) - 0.35) + smoothstep(
                0.04, 0.0, np.abs(place - 1.6) - 0.06
            )
            glaze = mix(glaze, second, np.clip(band, 0.0, 1.0))
        elif self.decor == "drips":
            front = smoothstep(-0.1, 0.1, z - 6.0 * np.floor(z / 6.0) - 3.0 + 2.2 * fbm(points * 3.0, 2))
            glaze, height = mix(glaze, second, front), height + 0.004 * front
        elif self.decor != "none":
            cells = worley(points / (0.35 * self.scale))
            if self.decor == "speckles":
                dot = smoothstep(0.3, 0.18, cells.first) * (cells.random[0] < 0.6)
                glaze = mix(glaze, second * 0.6, 0.85 * dot)
            else:
                line = 1.0 - smoothstep(0.01, 0.06, cells.second - cells.first)
                glaze, height = glaze * (1.0 - 0.55 * line), height - 0.0008 * line
                rough = rough + 0.1 * line
        return Look(glaze, rough, 0.0, height)
