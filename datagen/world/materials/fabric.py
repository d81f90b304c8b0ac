"""Fabric: a weave of threads, plain, striped or checked."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, laid, mix, near
from datagen.world.materials.noise import cell_random, fbm
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

DYES: tuple[Triple, ...] = (
    (0.66, 0.62, 0.54),
    (0.06, 0.09, 0.20),
    (0.40, 0.05, 0.05),
    (0.10, 0.20, 0.12),
    (0.50, 0.33, 0.09),
    (0.05, 0.05, 0.055),
    (0.36, 0.32, 0.27),
    (0.20, 0.10, 0.16),
    (0.14, 0.28, 0.38),
    (0.55, 0.25, 0.20),
)
"""Linen, navy, crimson, bottle green, mustard, black, taupe, plum, teal and salmon; linear."""

Pattern = Literal["plain", "stripes", "check", "melange"]
PATTERNS: tuple[Pattern, ...] = ("plain", "stripes", "check", "melange")


class FabricSpec(Solid):
    """Fabric.

    Attributes:
        pattern: of the colours.
        colors: of the ground and of the figure.
        thread: distance of threads, world units.
        twill: threads of warp that the weave shifts by from one thread of weft to the next: 1 or 0.5.
        repeat: threads after which stripes and checks repeat.
    """

    family: Literal["fabric"] = "fabric"
    roles = ("any", "fabric")
    pattern: Pattern
    colors: tuple[Triple, Triple]
    thread: Number
    twill: Number
    repeat: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:
        return cls(
            offset=draw_offset(rng),
            pattern=PATTERNS[int(rng.integers(len(PATTERNS)))],
            colors=(near(rng, DYES, 0.25), near(rng, DYES, 0.25)),
            thread=between(rng, 0.03, 0.07) if large or role == "any" else between(rng, 0.025, 0.05),
            twill=1.0 if rng.random() < 0.6 else 0.5,
            repeat=float(rng.integers(4, 14)),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:
        u, v, side = laid(points, normals)
        sag = fbm(points * 3.0, 2)
        u, v = (u + 0.01 * sag) / self.thread, (v - 0.01 * sag) / self.thread
        warp, weft = np.floor(u), np.floor(v)
        x, y = u - warp - 0.5, v - weft - 0.5
        # Where warp lies over weft and back, as on a draughtboard or on its diagonals.
        over = np.sin(np.float32(np.pi) * (u + self.twill * v)) * np.sin(np.float32(np.pi) * v)
        up = 1.0 / (1.0 + np.exp(-6.0 * over))
        round_warp = np.sqrt(np.maximum(1.0 - 3.2 * x * x, 0.0))
        round_weft = np.sqrt(np.maximum(1.0 - 3.2 * y * y, 0.0))
        crest = mix(round_weft, round_warp, up)
        of_warp, of_weft = cell_random(warp, side), cell_random(weft, side + 7)
        figure = self._figure(warp, weft, up, of_warp[1], of_weft[1])
        shade = 0.82 + 0.3 * mix(of_weft[0], of_warp[0], up) + 0.1 * sag
        color = mix(column(self.colors[0]), column(self.colors[1]), figure) * (shade * (0.45 + 0.55 * crest))
        height = (0.3 * self.thread) * crest * (0.7 + 0.3 * np.abs(over))
        return Look(color, 0.92 - 0.1 * crest, 0.0, height)

    def _figure(
        self, warp: np.ndarray, weft: np.ndarray, up: np.ndarray, r_warp: np.ndarray, r_weft: np.ndarray
    ) -> np.ndarray:
        """Share of the second colour in each thread that lies on top."""
        repeat = self.repeat
        if self.pattern == "stripes":
            return (warp % repeat < 0.4 * repeat).astype(np.float32)
        if self.pattern == "check":
            return mix(weft % repeat < 0.4 * repeat, (warp % repeat < 0.4 * repeat).astype(np.float32), up)
        if self.pattern == "melange":
            return 0.55 * mix(r_weft, r_warp, up)
        return np.zeros_like(up)
