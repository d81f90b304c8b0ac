"""Ground: soil, gravel, sand, grass and snow, flat but for their relief."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, mix, near, smoothstep
from datagen.world.materials.noise import fbm, gradient_noise, worley
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

Sort = Literal["soil", "gravel", "sand", "grass", "snow"]
COLORS: dict[Sort, tuple[Triple, ...]] = {
    "soil": ((0.13, 0.085, 0.055), (0.20, 0.13, 0.085), (0.24, 0.11, 0.06)),
    "gravel": ((0.26, 0.25, 0.23), (0.34, 0.29, 0.23), (0.16, 0.155, 0.15)),
    "sand": ((0.48, 0.38, 0.25), (0.40, 0.32, 0.22), (0.52, 0.30, 0.16)),
    "grass": ((0.09, 0.16, 0.035), (0.13, 0.19, 0.05), (0.20, 0.19, 0.07)),
    "snow": ((0.84, 0.86, 0.88),),
}
"""Linear."""


class GroundSpec(Solid):
    """Ground.

    Attributes:
        sort: which.
        color: its main colour.
        scale: size of stones, tufts or ripples, world units.
        bare: share of soil among stones or grass.
    """

    family: Literal["ground"] = "ground"
    roles = ("ground",)
    sort: Sort
    color: Triple
    scale: Number
    bare: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        sorts = tuple(COLORS)
        sort = sorts[int(rng.choice(len(sorts), p=(0.27, 0.25, 0.2, 0.22, 0.06)))]
        return cls(
            offset=draw_offset(rng),
            sort=sort,
            color=near(rng, COLORS[sort], 0.06 if sort == "snow" else 0.25),
            scale=between(rng, 0.06, 0.16),
            bare=rng.uniform(0.0, 0.5),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:  # noqa: ARG002
        cloud = fbm(points * 0.9, 4, 0.6)
        fine = fbm(points * 13.0, 3, 0.6)
        base = column(self.color)
        if self.sort == "snow":
            drift = fbm(points / (4.0 * self.scale), 2)
            return Look(base * (1.0 + 0.03 * fine), 0.7 + 0.1 * fine, 0.0, 0.02 * drift + 0.002 * fine)
        if self.sort == "sand":
            across = points[0] + 0.3 * points[1] + 0.35 * cloud
            ripple = 0.5 + 0.5 * np.sin(np.float32(2 * np.pi) * across / (2.0 * self.scale))
            show = smoothstep(-0.5, 0.4, cloud + 0.2 * fine)
            color = base * (1.0 + 0.14 * fine + 0.12 * cloud + 0.1 * show * ripple)
            return Look(color, 0.9 - 0.05 * ripple, 0.0, (0.12 * self.scale) * ripple * show + 0.002 * fine)
        soil = column((0.13, 0.09, 0.06)) if self.sort != "soil" else base
        soil = soil * (1.0 + 0.5 * fine + 0.3 * cloud)
        if self.sort == "grass":
            return self._grass(points, base, soil, cloud, fine)
        stones = worley(points / (self.scale if self.sort == "gravel" else 1.3 * self.scale))
        share = 1.0 - self.bare if self.sort == "gravel" else 0.18
        there = (stones.random[0] < share) * smoothstep(0.03, 0.14, stones.second - stones.first)
        round_top = there * np.sqrt(np.maximum(1.0 - 1.3 * stones.first * stones.first, 0.0))
        shade = np.exp(0.9 * (stones.random[1] - 0.5)) * (1.0 + 0.2 * fine)
        tint = np.stack([0.92 + 0.18 * stones.random[2], np.ones_like(shade), 1.06 - 0.2 * stones.random[2]])
        stone = (base if self.sort == "gravel" else column((0.28, 0.25, 0.22))) * (shade * tint)
        # The earth between stones lies in their shade.
        color = mix(soil * (0.5 if self.sort == "gravel" else 1.0), stone, there)
        height = (0.3 * self.scale) * round_top + 0.008 * fine + 0.02 * cloud
        return Look(color, 0.93 - 0.15 * there * stones.random[3], 0.0, height)

    def _grass(
        self, points: np.ndarray, base: np.ndarray, soil: np.ndarray, cloud: np.ndarray, fine: np.ndarray
    ) -> Look:
        """Blades seen from above: short strokes in turning directions, tufts, and dry patches."""
        turn = 2.5 * fbm(points / (2.0 * self.scale), 2)
        c, s = np.cos(turn), np.sin(turn)
        x, y, z = points
        along, across = c * x + s * y, c * y - s * x
        blade = gradient_noise(np.stack([5.0 * along, 24.0 * across, 5.0 * z]))
        tuft = fbm(points / (1.5 * self.scale), 2)
        dry = np.array([[2.1], [1.5], [1.4]], np.float32)
        green = base * ((1.0 + 0.65 * blade + 0.35 * tuft) * (0.75 + 0.5 * smoothstep(-0.4, 0.4, blade)))
        green = mix(green, green * dry, 0.8 * smoothstep(0.0, 0.6, cloud + 0.3 * tuft))
        cover = smoothstep(-0.15, 0.15, tuft + 0.4 * cloud + 0.3 * fine + (0.75 - 1.3 * self.bare))
        height = cover * (0.012 * blade + (0.12 * self.scale) * tuft + 0.01)
        return Look(mix(soil, green, cover), 0.9 - 0.18 * cover, 0.0, height)
