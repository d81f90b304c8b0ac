"""Things of single polygons, seen from both sides: cards, cloth of one layer, boxes and walls of quads.

Models that people bring are full of them. Light must not pass them, and neither side may shade the other.
The plant of such leaves stands with the plants.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from datagen.world.shapes.shape import Kind
from datagen.world.shapes.solids import Noise, Parts, between, count, layers


def _plane(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Grids x, y (side, side) over (-1, 1)."""
    line = np.linspace(-1.0, 1.0, side)
    x, y = np.meshgrid(line, line, indexing="ij")
    return x, y


def _wall(a: np.ndarray, b: np.ndarray, high: float) -> np.ndarray:
    """Upright quad (2, 2, 3) between two points (2,) of the floor."""
    return np.array([[[*a, 0.0], [*a, high]], [[*b, 0.0], [*b, high]]])


def card(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Card, sheet of paper or of metal: flat, bent one way, or with a corner that curls."""
    x, y = _plane(24)
    wide, bend = between(p[0], 0.5, 1.0), between(p[1], 0.0, 0.35)
    curl = np.maximum(x + y - between(p[2], 0.6, 1.6), 0.0) ** 2 * between(p[3], 0.0, 0.6)
    turn = float(rng.uniform(-0.5, 0.5))
    return [(layers([np.stack([x, wide * y, bend * (x + turn * y) ** 2 + curl], -1)]), 0)]


def throw(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Cloth of one layer that lies in waves and folds."""
    noise, swell = Noise(rng, octaves=2, gain=0.5), Noise(rng, octaves=1)
    x, y = _plane(80)
    flat = np.column_stack([x.ravel(), y.ravel() * between(p[0], 0.6, 1.0), np.zeros(x.size)])
    ridges = np.exp(-((noise(flat * between(p[1], 0.8, 1.4)) / 0.35) ** 2))
    flat[:, 2] = between(p[2], 0.1, 0.25) * ridges + between(p[3], 0.02, 0.12) * swell(flat * 0.9 + 7.3)
    return [(layers([flat.reshape(*x.shape, 3)]), 0)]


def open_box(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Carton without a lid: a floor and four walls, a quad each, half of them with flaps."""
    wide, high, opened = between(p[0], 0.6, 1.0), between(p[1], 0.4, 1.2), between(p[2], 0.3, 2.2)
    corners = np.array([[-1.0, -wide], [1.0, -wide], [1.0, wide], [-1.0, wide]])
    quads = [np.pad(corners, ((0, 0), (0, 1)))[[0, 1, 3, 2]].reshape(2, 2, 3)]
    for a, b in pairwise([*corners, corners[0]]):
        wall = _wall(a, b, high)
        quads.append(wall)
        if p[3] > 0.5:
            out, tilt = (a + b) / np.linalg.norm(a + b), opened * rng.uniform(0.8, 1.2)
            reach = 0.45 * wide * np.array([*np.sin(tilt) * out, np.cos(tilt)])
            quads.append(np.stack([wall[:, 1], wall[:, 1] + reach], axis=1))
    return [(layers(quads), 0)]


def screen(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Folding screen: walls of one polygon each that stand in a zigzag."""
    panels, high = count(p[0], 2, 5), between(p[1], 1.2, 2.4)
    turns = between(p[2], 0.3, 1.1) * np.where(np.arange(panels) % 2, -1.0, 1.0)
    steps = between(p[3], 0.6, 1.0) * np.column_stack([np.cos(turns), np.sin(turns)])
    line = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return [(layers(_wall(a, b, high) for a, b in pairwise(line)), 0)]


SHEETS: dict[str, Kind] = {
    "card": Kind(card, roles=("paper",)),
    "throw": Kind(throw, upright=True, roles=("fabric",)),
    "open_box": Kind(open_box, upright=True, roles=("any",)),
    "screen": Kind(screen, upright=True, roles=("any",), seeded=False),
}
