"""Stone: grains of granite, layers of sandstone and slate, and limestone's pits."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import (
    Look,
    Solid,
    column,
    direction,
    draw_offset,
    mix,
    near,
    smoothstep,
    turned,
)
from datagen.world.materials.noise import fbm, gradient_noise, ridged, worley
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

Sort = Literal["granite", "sandstone", "limestone", "slate", "rock"]
COLORS: dict[Sort, tuple[Triple, ...]] = {
    "granite": ((0.38, 0.36, 0.34), (0.36, 0.24, 0.19), (0.16, 0.16, 0.17)),
    "sandstone": ((0.50, 0.34, 0.20), (0.42, 0.22, 0.12), (0.52, 0.45, 0.33)),
    "limestone": ((0.58, 0.53, 0.44), (0.48, 0.46, 0.42)),
    "slate": ((0.07, 0.075, 0.085), (0.10, 0.11, 0.10), (0.13, 0.10, 0.10)),
    "rock": ((0.20, 0.18, 0.16), (0.28, 0.26, 0.23), (0.15, 0.15, 0.14)),
}
"""Linear."""


class StoneSpec(Solid):
    """Stone.

    Attributes:
        sort: which.
        color: its main colour, linear.
        grain: size of its features, world units.
        layers: unit direction across its layers.
        roughness: of cut or broken faces.
    """

    family: Literal["stone"] = "stone"
    roles = ("any", "stone")
    sort: Sort
    color: Triple
    grain: Number
    layers: Triple
    roughness: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        sort = tuple(COLORS)[int(rng.integers(len(COLORS)))]
        tilt = np.asarray(direction(rng)) * 0.35 + (0.0, 0.0, 1.0)
        return cls(
            offset=draw_offset(rng),
            sort=sort,
            color=near(rng, COLORS[sort], 0.25),
            grain=between(rng, 0.03, 0.07),
            layers=tuple((tilt / np.linalg.norm(tilt)).tolist()),
            roughness=rng.uniform(0.15, 0.6) if sort == "granite" else rng.uniform(0.6, 0.9),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:  # noqa: ARG002
        base = column(self.color)
        if self.sort == "granite":
            return self._granite(points, base)
        if self.sort in ("sandstone", "slate"):
            return self._layered(points, base)
        return self._massive(points, base)

    def _granite(self, points: np.ndarray, base: np.ndarray) -> Look:
        cells = worley(points / (0.6 * self.grain))
        kind = cells.random[0]
        shade = np.where(kind < 0.15, 0.35, np.where(kind < 0.65, 0.9, 1.3)) + 0.25 * (cells.random[1] - 0.5)
        cloud = fbm(points * 1.5, 2)
        quartz = (kind > 0.8).astype(np.float32)
        color = mix(base * shade, 0.62 * (0.8 + 0.4 * cells.random[2]), 0.7 * quartz)
        color = color * (1.0 + 0.12 * cloud)
        return Look(
            color, self.roughness + 0.15 * (kind < 0.2) - 0.08 * quartz, 0.0, 0.0006 * cells.random[3]
        )

    def _layered(self, points: np.ndarray, base: np.ndarray) -> Look:
        p = turned(points, self.layers)
        bend = fbm(p * np.array([[0.8], [0.8], [1.6]], np.float32), 3)
        depth = p[2] / (self.grain * 2.5) + 1.2 * bend
        layer = gradient_noise(np.stack([0.05 * p[0], 0.05 * p[1], depth]))
        fine = gradient_noise(np.stack([2.0 * p[0], 2.0 * p[1], 3.1 * depth]))
        grain = fbm(points / self.grain, 2)
        warm = np.array([[1.0], [0.92], [0.8]], np.float32)
        strength = 0.5 if self.sort == "sandstone" else 0.3
        color = base * (1.0 + strength * layer + 0.18 * fine + 0.15 * grain)
        color = mix(color, color * warm, smoothstep(0.0, 0.5, bend))
        height = 0.006 * layer + 0.003 * fine + 0.002 * grain
        return Look(color, self.roughness + 0.08 * grain - 0.1 * layer, 0.0, height)

    def _massive(self, points: np.ndarray, base: np.ndarray) -> Look:
        large = fbm(points * (0.12 / self.grain), 5, 0.6)
        pits = smoothstep(0.35, 0.65, fbm(points / (1.6 * self.grain), 2))
        crack = smoothstep(0.86, 0.98, ridged(points * (0.06 / self.grain), 2))
        if self.sort == "limestone":
            color = base * (1.0 + 0.2 * large - 0.35 * pits - 0.15 * crack)
            return Look(color, self.roughness + 0.1 * pits, 0.0, 0.006 * large - 0.006 * pits)
        moss = smoothstep(0.25, 0.6, large - 0.3 * pits) * 0.35
        green = np.array([[0.09], [0.11], [0.035]], np.float32)
        color = mix(base * (1.0 + 0.45 * large - 0.3 * pits - 0.5 * crack), green, moss)
        return Look(color, self.roughness + 0.1 * moss, 0.0, 0.022 * large - 0.012 * crack - 0.006 * pits)
