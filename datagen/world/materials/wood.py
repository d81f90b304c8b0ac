"""Wood: rings around a pith, fibres along it, and planks where it covers a floor."""

from __future__ import annotations

import math
from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import (
    Look,
    Solid,
    column,
    darker,
    direction,
    draw_offset,
    laid,
    mix,
    near,
    smoothstep,
    turned,
)
from datagen.world.materials.noise import cell_random, fbm, gradient_noise
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

SPECIES: tuple[Triple, ...] = (
    (0.42, 0.25, 0.11),
    (0.60, 0.41, 0.20),
    (0.13, 0.065, 0.032),
    (0.33, 0.13, 0.055),
    (0.55, 0.44, 0.28),
    (0.06, 0.045, 0.035),
    (0.30, 0.27, 0.23),
    (0.24, 0.10, 0.05),
)
"""Oak, pine, walnut, cherry, ash, ebony, weathered grey, mahogany; linear."""


class WoodSpec(Solid):
    """Wood.

    Attributes:
        axis: unit direction of the pith and of the fibres.
        ring: width of a year's ring, world units.
        early, late: colours of its bright and its dark part.
        roughness: of the finish: 0.2 varnished, 0.8 raw.
        plank: width of planks, world units; 0: a piece of solid wood.
    """

    family: Literal["wood"] = "wood"
    roles = ("any", "wood")
    axis: Triple
    ring: Number
    early: Triple
    late: Triple
    roughness: Number
    plank: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        early = near(rng, SPECIES, 0.2)
        planks = large or rng.random() < 0.15
        axis = np.array([*direction(rng, flat=True)[:2], rng.uniform(-0.1, 0.1)])
        if not planks:
            axis = np.roll(axis, int(rng.integers(3)))
        axis /= np.linalg.norm(axis)
        return cls(
            offset=draw_offset(rng),
            axis=tuple(axis.tolist()),
            ring=between(rng, 0.05, 0.13),
            early=early,
            late=darker(early, rng.uniform(0.45, 0.75)),
            roughness=rng.uniform(0.25, 0.8),
            plank=between(rng, 0.15, 0.45) if planks else 0.0,
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:
        gap, tint = 0.0, 1.0
        if self.plank:
            points, gap, tint = self._planks(points, normals)
        p = turned(points, self.axis)
        along = np.stack([p[0] * 1.3, p[1] * 1.3, p[2] * 0.35])
        bend = fbm(along, 3)
        # The pith lies beside most pieces: what is cut from a trunk shows arcs, rarely whole rings.
        radius = np.hypot(p[0] % 4.0 - 2.0, p[1] % 4.0 - 2.3) + 0.16 * bend
        # Good years are wide, poor ones narrow and pale.
        year = radius / self.ring + 1.1 * gradient_noise(
            np.stack([0.4 * radius / self.ring, 0 * bend, 0 * bend])
        )
        phase = year - np.floor(year)
        late = smoothstep(0.2, 0.9, phase) * (1.0 - smoothstep(0.9, 1.0, phase))
        late = late * (0.35 + 0.65 * cell_random(np.floor(year))[0])
        # Fibres at a fixed width, as seen: finer ones are below what a picture resolves.
        fibre = gradient_noise(np.stack([p[0] * 28.0, p[1] * 28.0, p[2] * 1.6]))
        pore = smoothstep(0.25, 0.6, fibre) * (0.35 + 0.65 * late)
        stain = 1.0 + 0.22 * bend + 0.1 * fibre
        color = mix(column(self.early), column(self.late), np.clip(late * 0.8 + 0.25 * pore, 0, 1)) * stain
        color = color * (tint * (1.0 - 0.8 * gap))
        rough = self.roughness + 0.12 * pore - 0.08 * late + 0.05 * bend + 0.3 * gap
        height = 0.0012 * late - 0.0015 * pore - 0.012 * gap
        return Look(color, rough, 0.0, height)

    def _planks(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points moved to each plank's own place in the wood; gaps in [0, 1]; brightness of the planks."""
        u, v, side = laid(points, normals)
        # Along the wood's own direction on floors, level elsewhere.
        length = math.hypot(self.axis[0], self.axis[1])
        c, s = self.axis[0] / length, self.axis[1] / length
        down = side == 2
        along = np.where(down, c * u + s * v, u)
        across = np.where(down, c * v - s * u, v)
        row = np.floor(across / self.plank)
        shift = cell_random(row, side)[0]
        span = self.plank * 6.0
        board = np.floor(along / span + shift * 5.0)
        r = cell_random(row, board, side)
        edge = np.minimum(
            np.abs(across / self.plank - np.round(across / self.plank)) * self.plank,
            np.abs(along / span + shift * 5.0 - np.round(along / span + shift * 5.0)) * span,
        )
        gap = 1.0 - smoothstep(0.003, 0.012, edge)
        # Boards are laid along the fibres: the frame of the wood follows them.
        p = np.stack([c * along - s * across, s * along + c * across, points[2] * 0.2])
        moved = p + np.stack([9.0 * r[0], 9.0 * r[1], 9.0 * r[2]])
        return moved, gap, 0.75 + 0.5 * r[3]
