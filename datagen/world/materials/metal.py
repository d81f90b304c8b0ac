"""Bare metal: brushed, scratched, hammered, cast or blasted, its colour the reflectance measured of it."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import (
    Look,
    Solid,
    column,
    direction,
    draw_offset,
    laid,
    mix,
    smoothstep,
)
from datagen.world.materials.noise import fbm, gradient_noise, worley
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

REFLECTANCES: dict[str, Triple] = {
    "silver": (0.88, 0.87, 0.83),
    "aluminium": (0.85, 0.86, 0.87),
    "gold": (0.88, 0.69, 0.31),
    "copper": (0.88, 0.60, 0.50),
    "brass": (0.84, 0.71, 0.39),
    "bronze": (0.66, 0.52, 0.34),
    "iron": (0.53, 0.51, 0.49),
    "steel": (0.63, 0.62, 0.61),
    "titanium": (0.54, 0.50, 0.45),
    "chromium": (0.55, 0.56, 0.56),
}
"""Linear reflectance at normal incidence, after Lagarde, "Feeding a physically based shading model" (2011),
the brightest 0.05 to 0.1 lower for what air leaves on them."""

Finish = Literal["brushed", "scratched", "hammered", "cast", "blasted"]
FINISHES: tuple[Finish, ...] = ("brushed", "scratched", "hammered", "cast", "blasted")


class MetalSpec(Solid):
    """Bare metal.

    Attributes:
        finish: what was done to it.
        color: linear reflectance at normal incidence.
        roughness: where it is not worn.
        grain: unit direction of the brush.
        scale: size of dents, world units.
        tarnish: how far its colour darkens in patches.
    """

    family: Literal["metal"] = "metal"
    roles = ("any", "metal")
    finish: Finish
    color: Triple
    roughness: Number
    grain: Triple
    scale: Number
    tarnish: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        finish = FINISHES[int(rng.integers(len(FINISHES)))]
        names = tuple(REFLECTANCES)
        rough = {
            "brushed": (0.25, 0.5),
            "scratched": (0.15, 0.4),
            "hammered": (0.15, 0.45),
            "cast": (0.4, 0.7),
            "blasted": (0.65, 0.95),
        }
        return cls(
            offset=draw_offset(rng),
            finish=finish,
            color=REFLECTANCES[names[int(rng.integers(len(names)))]],
            roughness=rng.uniform(*rough[finish]),
            grain=direction(rng),
            scale=between(rng, 0.08, 0.2),
            tarnish=rng.uniform(0.0, 0.6) ** 2,
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:
        cloud = fbm(points * 2.0, 3)
        color = column(self.color)
        rough: np.ndarray | float = self.roughness + 0.08 * cloud
        if self.finish == "brushed":
            along = np.asarray(self.grain, np.float32)
            across = points - along[:, None] * (along @ points) * 0.97
            streak = 0.6 * gradient_noise(across * 34.0) + 0.4 * gradient_noise(across * 71.0 + 3.0)
            rough = rough + 0.16 * streak
            color, height = color * (1.0 + 0.1 * streak), 0.0004 * streak
        elif self.finish == "scratched":
            scratch = self._scratches(points, normals)
            rough = rough + 0.3 * scratch
            color, height = color * (1.0 - 0.15 * scratch), -0.0012 * scratch
        elif self.finish == "hammered":
            dents = worley(points / self.scale, 0.8)
            height = (0.16 * self.scale) * np.minimum(dents.first, 0.75) ** 2
            rough = rough + 0.1 * smoothstep(0.25, 0.0, dents.second - dents.first)
        else:
            pits = smoothstep(0.2, 0.7, fbm(points * 24.0, 2))
            rough = rough + 0.15 * pits
            color, height = color * (1.0 - 0.2 * pits), 0.0025 * cloud - 0.002 * pits
        stain = self.tarnish * smoothstep(-0.3, 0.7, cloud)
        dull = np.array([[0.62], [0.52], [0.42]], np.float32)
        return Look(mix(color, color * dull, stain), rough + 0.25 * stain, 1.0, height)

    def _scratches(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Scratches (N,) in [0, 1]: crests of noise that is long one way, in three ways, here and there."""
        u, v, side = laid(points, normals)
        total = np.zeros(len(u), np.float32)
        for k, (angle, fine) in enumerate(((0.4, 5.0), (1.5, 7.0), (2.5, 6.0))):
            c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
            along, across = c * u + s * v, c * v - s * u
            bend = 0.03 * gradient_noise(np.stack([1.5 * u, 1.5 * v, 3.0 * side + k]))
            line = np.abs(
                gradient_noise(np.stack([0.7 * along, fine * (across + bend), 5.0 * side + 9.0 * k]))
            )
            where = smoothstep(
                0.0, 0.35, gradient_noise(np.stack([1.3 * along, 2.6 * across, side + 17.0 * k]))
            )
            total = np.maximum(total, (1.0 - smoothstep(0.0, 0.06, line)) * where)
        return total
