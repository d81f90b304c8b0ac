"""Tiles: glazed or stone squares, oblongs and hexagons with grout between them."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, laid, mix, near, smoothstep
from datagen.world.materials.noise import cell_random, fbm
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

Layout = Literal["square", "checker", "subway", "hexagon", "motif"]
LAYOUTS: tuple[Layout, ...] = ("square", "checker", "subway", "hexagon", "motif")
GLAZES: tuple[Triple, ...] = (
    (0.72, 0.70, 0.66),
    (0.10, 0.24, 0.30),
    (0.08, 0.12, 0.28),
    (0.16, 0.30, 0.17),
    (0.44, 0.17, 0.09),
    (0.05, 0.05, 0.055),
    (0.55, 0.44, 0.30),
    (0.40, 0.40, 0.40),
    (0.60, 0.62, 0.52),
)
"""White, petrol, cobalt, green, terracotta, black, sand, grey and celadon; linear."""

GROUTS: tuple[Triple, ...] = ((0.45, 0.43, 0.40), (0.18, 0.17, 0.16), (0.62, 0.60, 0.56))


class TilesSpec(Solid):
    """Tiles.

    Attributes:
        layout: how they are laid; ``checker`` and ``motif`` have a second colour.
        colors: first and second colour.
        grout: colour of the joints.
        size: edge of a tile, world units.
        joint: width of the joints, world units.
        roughness: of the glaze.
        variation: how far tiles differ in brightness.
    """

    family: Literal["tiles"] = "tiles"
    roles = ("any", "tiles")
    layout: Layout
    colors: tuple[Triple, Triple]
    grout: Triple
    size: Number
    joint: Number
    roughness: Number
    variation: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        size = between(rng, 0.25, 0.7) if large else between(rng, 0.12, 0.35)
        return cls(
            offset=draw_offset(rng),
            layout=LAYOUTS[int(rng.integers(len(LAYOUTS)))],
            colors=(near(rng, GLAZES, 0.2), near(rng, GLAZES, 0.2)),
            grout=near(rng, GROUTS, 0.15),
            size=size,
            joint=size * rng.uniform(0.03, 0.07),
            roughness=rng.uniform(0.12, 0.55),
            variation=rng.uniform(0.03, 0.25),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:
        u, v, side = laid(points, normals)
        edge, column_of, row_of, x, y = self._cells(u / self.size, v / self.size)
        edge = edge * self.size
        r = cell_random(column_of, row_of, side)
        first, second = (column(color) for color in self.colors)
        base = first
        if self.layout == "checker":
            base = np.where((column_of + row_of) % 2.0 == 0.0, first, second)
        elif self.layout == "motif":
            # Four quarter circles and a diamond: the cement tile of a hundred years ago.
            corner = np.hypot(0.5 - np.abs(x), 0.5 - np.abs(y))
            ring = smoothstep(0.02, 0.0, np.abs(corner - 0.33) - 0.05)
            diamond = smoothstep(0.02, 0.0, np.abs(x) + np.abs(y) - 0.2)
            base = mix(first, second, np.maximum(ring, diamond))
        cloud = fbm(points * 2.5, 3)
        tile = base * (np.exp(self.variation * (2.0 * r[0] - 1.0)) * (1.0 + 0.08 * cloud))
        solid = smoothstep(0.35 * self.joint, 0.6 * self.joint, edge)
        grout = column(self.grout) * (1.0 + 0.3 * cloud)
        rough = mix(0.9, self.roughness + 0.06 * r[1] + 0.08 * cloud, solid)
        bevel = smoothstep(0.3 * self.joint, 1.2 * self.joint, edge)
        height = 0.5 * self.joint * bevel + 0.08 * self.joint * r[2] * solid + 0.001 * cloud
        return Look(mix(grout, tile, solid), rough, 0.0, height)

    def _cells(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
        """Distance to the tile's edge, its two indices, and the place within it from -0.5 to 0.5."""
        if self.layout == "hexagon":
            # Two lattices of rectangles 1 by root 3, half a step apart: the nearer centre is the tile's.
            s = np.float32(np.sqrt(3.0))
            ax, ay = u - np.round(u), v - s * np.round(v / s)
            bu, bv = u - 0.5, v - 0.5 * s
            bx, by = bu - np.round(bu), bv - s * np.round(bv / s)
            odd = bx * bx + by * by < ax * ax + ay * ay
            x, y = np.where(odd, bx, ax), np.where(odd, by, ay)
            column_of = 2.0 * np.where(odd, np.round(bu) + 0.5, np.round(u))
            row_of = 2.0 * np.where(odd, np.round(bv / s) + 0.5, np.round(v / s))
            edge = 0.5 - np.maximum(np.abs(x), 0.5 * np.abs(x) + np.float32(np.sqrt(0.75)) * np.abs(y))
            return edge, column_of, row_of, x, y
        row = np.floor(v * 2.0) if self.layout == "subway" else np.floor(v)
        if self.layout == "subway":
            u, height, y = u + 0.5 * (row % 2.0), 0.5, v * 2.0 - row - 0.5
        else:
            height, y = 1.0, v - row - 0.5
        across = np.floor(u)
        x = u - across - 0.5
        return np.minimum(0.5 - np.abs(x), (0.5 - np.abs(y)) * height), across, row, x, y
