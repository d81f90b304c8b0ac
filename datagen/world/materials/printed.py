"""Print: pages, posters and labels with lines of marks like type, headlines and pictures."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np

from datagen.world.materials.material import Look, Solid, column, draw_offset, laid, mix, near, smoothstep
from datagen.world.materials.noise import cell_random, fbm, gradient_noise
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

PAPERS: tuple[Triple, ...] = (
    (0.78, 0.77, 0.73),
    (0.68, 0.62, 0.50),
    (0.44, 0.32, 0.20),
    (0.70, 0.52, 0.10),
    (0.60, 0.68, 0.72),
)
"""White, cream, kraft, yellow and pale blue paper; linear."""

INKS: tuple[Triple, ...] = ((0.03, 0.03, 0.035), (0.45, 0.04, 0.04), (0.03, 0.08, 0.30), (0.05, 0.20, 0.10))


class PrintSpec(Solid):
    """Print, laid on the side that a surface faces most.

    Attributes:
        paper, ink, second: colours of the paper, of the text, and of bars and pictures.
        line: distance of lines, world units.
        page: width of a page, in lines; its height is 1.4 of it.
        pictured: share of blocks that are pictures.
        roughness: of the paper.
    """

    family: Literal["print"] = "print"
    roles = ("any", "paper")
    paper: Triple
    ink: Triple
    second: Triple
    line: Number
    page: Number
    pictured: Number
    roughness: Number

    @classmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:  # noqa: ARG003
        return cls(
            offset=draw_offset(rng),
            paper=near(rng, PAPERS, 0.12),
            ink=near(rng, INKS, 0.15),
            second=near(rng, INKS[1:], 0.4),
            line=between(rng, 0.045, 0.08),
            page=float(rng.integers(10, 20)),
            pictured=rng.uniform(0.1, 0.5),
            roughness=rng.uniform(0.3, 0.85),
        )

    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:
        u, v, side = laid(points, normals)
        wide, high = self.page, float(round(1.4 * self.page))
        x, y = u / self.line, -v / self.line
        sheet_x, sheet_y = np.floor(x / wide), np.floor(y / high)
        x, y = x - sheet_x * wide, y - sheet_y * high
        margin = (np.minimum(np.minimum(x, wide - x), np.minimum(y, high - y)) > 1.0).astype(np.float32)
        row = np.floor(y)
        # Five lines of a page are one block: text, a picture, a headline or nothing.
        block = cell_random(np.floor(row / 5.0), sheet_x, sheet_y + 31.0 * side)
        picture = block[0] < self.pictured
        headline = (row % 5.0 == 0.0) & (block[1] < 0.5) & ~picture
        words = self._words(x, y - row, row + 57.0 * sheet_y, sheet_x + 13.0 * side)
        large = self._words(0.45 * x, y - row, row + 91.0 * sheet_y, sheet_x + 29.0 * side)
        bar = (headline & (block[2] < 0.4)).astype(np.float32)
        text = np.where(headline, np.where(bar > 0, 0.0, large), words) * ~picture * margin
        page = mix(column(self.paper), column(self.ink), text)
        page = mix(page, column(self.second), bar * margin)
        tone = gradient_noise(np.stack([0.35 * x, 0.35 * y, 11.0 * block[3]]))
        hills = smoothstep(-0.05, 0.05, tone)[None]
        warm = column(self.second) * 1.3 + 0.06
        scene = mix(warm, column(self.paper) * (0.55 + 0.4 * tone), hills)
        page = mix(page, scene, picture * margin)
        fibre = fbm(points * 12.0, 2)
        inked = np.clip(text + (bar + picture) * margin, 0.0, 1.0)
        color = page * (1.0 + 0.04 * fibre)
        return Look(color, self.roughness - 0.08 * inked + 0.05 * fibre, 0.0, 0.0005 * fibre)

    def _words(self, x: np.ndarray, y: np.ndarray, row: np.ndarray, sheet: np.ndarray) -> np.ndarray:
        """Ink (N,) of a line of marks: words of several letters, each letter a few strokes."""
        letter = np.floor(x * 1.8)
        r = cell_random(letter, row, sheet)
        # A gap after each word: words are as long as chance leaves them.
        gap = r[0] < 0.18
        within = x * 1.8 - letter
        stem = np.abs(within - 0.28) < 0.13
        top, middle, foot = np.abs(y - 0.28) < 0.07, np.abs(y - 0.48) < 0.07, np.abs(y - 0.7) < 0.07
        arch = (top & (r[1] < 0.7)) | (middle & (r[2] < 0.5)) | (foot & (r[3] < 0.6))
        second = (np.abs(within - 0.72) < 0.12) & (r[1] > 0.35)
        tall = np.where(r[2] > 0.7, 0.08, 0.22)
        body = (y > tall) & (y < 0.77) & (within < 0.86)
        return ((stem | second | (arch & (within > 0.15))) & body & ~gap).astype(np.float32)
