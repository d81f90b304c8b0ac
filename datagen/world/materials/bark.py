"""Bark: furrows along the trunk, plates between them, lichen on them."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, mix, near, smoothstep
from datagen.world.materials.noise import fbm, gradient_noise, ridged
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

BARKS: tuple[Triple, ...] = (
    (0.15, 0.10, 0.065),
    (0.22, 0.17, 0.13),
    (0.10, 0.075, 0.055),
    (0.28, 0.14, 0.075),
)
BIRCH: Triple = (0.62, 0.60, 0.55)
LICHEN: tuple[Triple, ...] = ((0.24, 0.28, 0.20), (0.14, 0.17, 0.06), (0.34, 0.31, 0.14))


class BarkSpec(Solid):
    """Bark; the trunk stands along z.

    Attributes:
        sort: furrowed as on oaks, or smooth with dark bands as on birches.
        color, lichen: of the plates, and of what grows on them.
        scale: distance of furrows, world units.
        covered: share of lichen.
    """

    family: Literal["bark"] = "bark"
    roles = ("bark",)
    sort: Literal["furrowed", "birch"]
    color: Triple
    lichen: Triple
    scale: Number
    covered: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        sort = "birch" if rng.random() < 0.2 else "furrowed"
        return cls(
            offset=draw_offset(rng),
            sort=sort,
            color=near(rng, (BIRCH,) if sort == "birch" else BARKS, 0.2),
            lichen=near(rng, LICHEN, 0.2),
            scale=between(rng, 0.09, 0.22),
            covered=rng.uniform(0.0, 0.5),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:  # noqa: ARG002
        x, y, z = points
        fine = fbm(points * 11.0, 3)
        if self.sort == "birch":
            band = gradient_noise(np.stack([2.0 * x, 2.0 * y, z / (0.35 * self.scale)]))
            dark = smoothstep(0.32, 0.5, band + 0.15 * fine)
            color = mix(column(self.color) * (1.0 + 0.12 * fine), 0.045, 0.9 * dark)
            return Look(color, 0.65 + 0.2 * dark, 0.0, 0.003 * fine - 0.004 * dark)
        p = np.stack([x, y, 0.28 * z]) / self.scale
        bend = fbm(p * 0.7, 2)
        furrow = ridged(p * 0.8 + 0.5 * np.stack([bend, -bend, bend]), 3, 0.4)
        deep = smoothstep(0.45, 0.85, furrow)
        color = column(self.color) * ((1.0 + 0.35 * fine + 0.3 * bend) * (1.0 - 0.75 * deep))
        grown = smoothstep(0.2, 0.5, fbm(points * 3.0 + 4.0, 3) + (self.covered - 0.35)) * (1.0 - deep)
        color = mix(color, column(self.lichen) * (1.0 + 0.3 * fine), 0.8 * grown)
        height = (0.22 * self.scale) * (1.0 - deep) * (1.0 - 0.5 * furrow) + 0.006 * fine
        return Look(color, 0.88 + 0.05 * fine, 0.0, height)
