"""Rust that eats through painted or bare iron."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, mix, near, smoothstep
from datagen.world.materials.noise import fbm
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

RUST: tuple[Triple, ...] = ((0.22, 0.075, 0.025), (0.30, 0.12, 0.04), (0.15, 0.06, 0.03))
PAINTS: tuple[Triple, ...] = (
    (0.42, 0.06, 0.04),
    (0.07, 0.16, 0.30),
    (0.12, 0.24, 0.14),
    (0.62, 0.60, 0.54),
    (0.55, 0.38, 0.05),
    (0.10, 0.10, 0.11),
)
IRON: Triple = (0.46, 0.44, 0.42)


class RustSpec(Solid):
    """Rusting iron.

    Attributes:
        paint: colour of the paint on it, or None where it is bare.
        rust: colour of the rust.
        amount: share of the surface that is rusted, about.
        scale: size of the patches, world units.
        gloss: roughness of what is not rusted.
    """

    family: Literal["rust"] = "rust"
    roles = ("any", "metal")
    paint: Triple | None
    rust: Triple
    amount: Number
    scale: Number
    gloss: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        return cls(
            offset=draw_offset(rng),
            paint=near(rng, PAINTS, 0.2) if rng.random() < 0.6 else None,
            rust=near(rng, RUST, 0.2),
            amount=rng.uniform(0.2, 0.75),
            scale=between(rng, 0.25, 0.7),
            gloss=rng.uniform(0.25, 0.5),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:  # noqa: ARG002
        patch = fbm(points / self.scale, 5, 0.6)
        fine = fbm(points * 14.0 + 5.0, 3)
        level = patch + 0.25 * fine + 2.0 * (self.amount - 0.5)
        eaten = smoothstep(-0.02, 0.1, level)
        edge = smoothstep(-0.2, 0.0, level) * (1.0 - eaten)
        shade = 1.0 + 0.55 * fine + 0.3 * patch
        orange = np.array([[1.7], [1.8], [1.6]], np.float32)
        rust = column(self.rust) * shade * mix(1.0, orange, smoothstep(0.1, 0.6, fine))
        if self.paint is None:
            under, metal = column(IRON) * (1.0 + 0.15 * patch), 1.0 - eaten
        else:
            # Chips show bare iron along the rust's front.
            chip = edge * smoothstep(0.0, 0.3, fine)
            under = mix(column(self.paint) * (1.0 + 0.08 * patch), column(IRON), chip)
            metal = chip * (1.0 - eaten)
        stain = np.array([[0.75], [0.55], [0.4]], np.float32)
        under = mix(under, under * stain, 0.7 * edge)
        rough = mix(self.gloss + 0.1 * edge, 0.88 + 0.08 * fine, eaten)
        height = eaten * (0.004 + 0.006 * fine) + (0.002 if self.paint else 0.0) * (1.0 - eaten)
        return Look(mix(under, rust, eaten), rough, metal, height)
