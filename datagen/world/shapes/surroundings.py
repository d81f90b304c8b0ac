"""Surroundings of the objects: floors, table tops, a room, terrain, and the space free over each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree
from trimesh import Trimesh

from datagen.world.shapes.shape import Kind
from datagen.world.shapes.solids import (
    Noise,
    Parts,
    between,
    count,
    layers,
    rounded_box,
    slab,
    smooth_profile,
    turned,
    union,
)

WALL = 0.2
"""Thickness of a room's walls in metres, its own unit."""

TERRAIN = 113
"""Points a side of a terrain's grid."""

COBBLES = 161
"""Points a side of the grid of a paved floor: four or more a stone."""


@dataclass(frozen=True)
class Standing:
    """Free space over a support, in the frame of the shape.

    Attributes:
        low, high: (3,) corners of the space; ``low[2]`` is where things stand, ``high[2]`` infinite under
            the open sky.
        heights: (n, m) heights over the rectangle, first index along x, where the ground is not flat.
    """

    low: np.ndarray
    high: np.ndarray
    heights: np.ndarray | None = None

    def moved(self, centre: np.ndarray, scale: float) -> Standing:
        """Return the space after ``(x - centre) * scale``."""
        heights = None if self.heights is None else (self.heights - centre[2]) * scale
        return Standing((self.low - centre) * scale, (self.high - centre) * scale, heights)

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return the height (N,) of the ground at points (N, 2), bilinear; the rim's height beyond it."""
        if self.heights is None:
            return np.full(len(points), self.low[2])
        share = (np.asarray(points) - self.low[:2]) / (self.high - self.low)[:2]
        at = (share * (np.array(self.heights.shape) - 1)).T
        return map_coordinates(self.heights, at, order=1, mode="nearest")


Space = Callable[[np.ndarray, np.random.Generator], Standing]


@dataclass(frozen=True)
class Surrounding(Kind):
    """Kind of support for things; ``standing`` returns the free space in the units of ``build``."""

    standing: Space = lambda _p, _rng: _over((1.0, 1.0), 0.0)


def _over(half: tuple[float, float], z: float, top: float = np.inf) -> Standing:
    x, y = half
    return Standing(np.array([-x, -y, z]), np.array([x, y, top]))


def floor(_p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """A square in the plane z = 0; its half side is its size over the root of two."""
    corners = [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]
    return [(Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False), 0)]


def cobbles(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """The same square paved with stones, their tops at z = 0 or less: relief that is geometry."""
    pitch, depth = between(p[0], 0.06, 0.13), between(p[1], 0.008, 0.03)
    line = np.arange(-1.0 - pitch, 1.0 + 2 * pitch, pitch)
    stones = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    stones += between(p[2], 0.15, 0.45) * pitch * rng.uniform(-1.0, 1.0, stones.shape)
    sunk, tilt = rng.random(len(stones)), rng.normal(0.0, 0.3, stones.shape)
    line = np.linspace(-1.0, 1.0, COBBLES)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)
    distances, nearest = KDTree(stones).query(grid, k=2)
    first, second, stone = distances[..., 0], distances[..., 1], np.asarray(nearest)[..., 0]
    rim = np.clip((second - first) / (between(p[3], 0.3, 0.8) * pitch), 0.0, 1.0)
    leant = ((grid - stones[stone]) * tilt[stone]).sum(axis=-1) / pitch
    top = -depth * np.clip(0.2 * (sunk[stone] + leant), 0.0, 1.0)
    heights = -depth + (top + depth) * np.sqrt(rim * (2.0 - rim))
    return [(layers([np.concatenate([grid, heights[..., None]], axis=-1)]), 0)]


def _top_sides(p: np.ndarray) -> tuple[float, float, float]:
    return 2.0, 2.0 * between(p[0], 0.6, 1.0), between(p[1], 0.05, 0.12)


def table_top(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Rectangular board with rounded edges."""
    x, y, thick = _top_sides(p)
    return [(rounded_box((x, y, thick), 0.3 * thick, (0.0, 0.0, -0.5 * thick)), 0)]


def _table_space(p: np.ndarray, _rng: np.random.Generator) -> Standing:
    x, y, thick = _top_sides(p)
    return _over((0.5 * x - 0.3 * thick, 0.5 * y - 0.3 * thick), 0.0)


def round_table(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Round top on a turned pillar with a wide foot."""
    thick, high = between(p[0], 0.04, 0.1), between(p[1], 0.8, 1.4)
    edge = np.array([[0.97, -thick], [0.99, -0.8 * thick], [1.0, -0.3 * thick], [0.985, 0.0]])
    waist = between(p[2], 0.07, 0.14)
    radii = np.array([0.55, 0.5, 1.4 * waist, waist, 1.5 * waist, waist, 2.2 * waist])
    pillar = smooth_profile(
        [-high, 0.05 - high, 0.12 - high, -0.6 * high, -0.45 * high, -0.3 * high, -thick], radii
    )
    return [(turned(pillar, 48), 0), (turned(edge, 128), 1)]


def backdrop(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Photographer's sweep: a sheet that lies flat and rises at the back in a wide curve."""
    bend, rise = between(p[0], 0.3, 0.7), between(p[1], 0.4, 1.0)
    angle = np.linspace(0.0, 0.5 * np.pi, 24)[1:]
    line = [(-1.0, 0.0), (0.9 - bend, 0.0)]
    line += [(0.9 - bend + bend * np.sin(a), bend * (1.0 - np.cos(a))) for a in angle]
    line.append((0.9, bend + rise))
    y, z = np.array(line).T
    along = np.stack([y, z], axis=-1)
    side = np.gradient(along, axis=0)
    side = np.column_stack([-side[:, 1], side[:, 0]]) / np.linalg.norm(side, axis=1, keepdims=True)
    x = np.array([-1.0, 1.0])[:, None, None]
    top = np.concatenate([np.broadcast_to(x, (2, len(y), 1)), np.broadcast_to(along, (2, len(y), 2))], -1)
    under = along - 0.03 * side
    low = np.concatenate([np.broadcast_to(x, (2, len(y), 1)), np.broadcast_to(under, (2, len(y), 2))], -1)
    return [(slab(top, low), 0)]


def _backdrop_space(p: np.ndarray, _rng: np.random.Generator) -> Standing:
    return Standing(np.array([-1.0, -1.0, 0.0]), np.array([1.0, 0.9 - between(p[0], 0.3, 0.7), np.inf]))


def _room_sides(p: np.ndarray) -> tuple[float, float, float]:
    """Inner sides of a room in metres."""
    return between(p[0], 3.4, 5.6), between(p[1], 3.2, 4.8), between(p[2], 2.4, 3.0)


def room_shell(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Room with wide windows in one or two walls, a doorway, at times a skylight.

    Slots: walls, floor, ceiling, joinery (frames and skirting). The fourth parameter is the share of the
    windows' wall that is open; openings take 3 m² at the least, most of them several times that.
    """
    x, y, z = _room_sides(p)
    hx, hy = 0.5 * x, 0.5 * y
    outer = Manifold.cube((x + 2 * WALL, y + 2 * WALL, z)).translate((-hx - WALL, -hy - WALL, 0.0))
    walls = outer - Manifold.cube((x, y, z + 2.0)).translate((-hx, -hy, -1.0))
    holes, joinery = [], []

    def opening(side: int, at: float, wide: float, low: float, high: float, bars: tuple[int, int]) -> None:
        """Hole in the wall +x (0), +y (1), -x (2) or -y (3), ``at`` along it, with a frame and its bars."""
        reach = hx if side % 2 == 0 else hy
        size, middle = (4 * WALL, wide, high - low), (reach + 0.5 * WALL, at, 0.5 * (low + high))
        hole = Manifold.cube(size, True).translate(middle)
        inner = Manifold.cube((WALL, wide - 0.1, high - low - 0.1), True).translate(middle)
        frame = Manifold.cube((0.07, wide, high - low), True).translate(middle) - inner
        for k in range(1, bars[0]):
            place = (middle[0], at + wide * (k / bars[0] - 0.5), middle[2])
            frame += Manifold.cube((0.05, 0.045, high - low - 0.02), True).translate(place)
        for k in range(1, bars[1]):
            place = (middle[0], at, low + (high - low) * k / bars[1])
            frame += Manifold.cube((0.05, wide - 0.02, 0.045), True).translate(place)
        holes.append(hole.rotate((0.0, 0.0, 90.0 * side)))
        joinery.append(frame.rotate((0.0, 0.0, 90.0 * side)))

    def windows(side: int, share: float) -> None:
        long = y if side % 2 == 0 else x
        number = count(rng.random(), 1, 3)
        sill = float(rng.uniform(0.05, 0.9))
        pitch = (long - 0.4) / number
        bars = (count(rng.random(), 1, 3), count(rng.random(), 1, 3))
        for k in range(number):
            at = (k + 0.5) * pitch - 0.5 * (long - 0.4)
            opening(side, at, share * pitch, sill, z - 0.2, bars)

    windows(0, between(p[3], 0.6, 0.92))
    if rng.random() < 0.5:
        windows(1, between(rng.random(), 0.5, 0.85))
    door = float(rng.uniform(-0.25, 0.25)) * x
    opening(3, door, float(rng.uniform(0.95, 1.6)), -0.5, 2.1, (1, 1))
    ceiling = Manifold.cube((x + 2 * WALL, y + 2 * WALL, WALL)).translate((-hx - WALL, -hy - WALL, z))
    if rng.random() < 0.35:
        cut = (0.45 * x, 0.4 * y, 4 * WALL)
        ceiling -= Manifold.cube(cut, True).translate((0.15 * x * float(rng.uniform(-1, 1)), 0.0, z))
    ground = Manifold.cube((x + 2 * WALL, y + 2 * WALL, WALL)).translate((-hx - WALL, -hy - WALL, -WALL))
    board = Manifold.cube((x, y, 0.09)).translate((-hx, -hy, 0.0))
    board -= Manifold.cube((x - 0.03, y - 0.03, 1.0), True)
    cuts = union(holes)
    return [
        (walls - cuts, 0),
        (ground, 1),
        (ceiling, 2),
        (union([board - cuts, *(frame.trim_by_plane((0, 0, 1), 0.0) for frame in joinery)]), 3),
    ]


def _room_space(p: np.ndarray, _rng: np.random.Generator) -> Standing:
    x, y, z = _room_sides(p)
    return _over((0.5 * x - 0.02, 0.5 * y - 0.02), 0.0, z)


def _terrain_heights(p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(n, n) heights over the square of half side 1: hills no steeper than about 15 degrees, and clods."""
    hills, clods = Noise(rng, octaves=3, gain=0.35), Noise(rng, octaves=3, gain=0.5)
    line = np.linspace(-1.0, 1.0, TERRAIN)
    x, y = np.meshgrid(line, line, indexing="ij")
    flat = np.column_stack([x.ravel(), y.ravel(), np.zeros(TERRAIN * TERRAIN)])
    frequency = between(p[0], 0.7, 1.6)
    heights = hills(flat * frequency).reshape(x.shape) * between(p[1], 0.015, 0.05)
    along, across = np.gradient(heights, line, line)
    slope = float(np.hypot(along, across).max())
    heights *= min(1.0, 0.25 / slope)
    heights += clods(flat * between(p[2], 5.0, 9.0)).reshape(x.shape) * between(p[3], 0.0005, 0.0025)
    # A rim that rises a little hides the horizon of the slab.
    return heights + 0.06 * np.clip(np.hypot(x, y) - 0.75, 0.0, None) ** 2


def terrain(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Gentle ground: a height field on a slab."""
    heights = _terrain_heights(p, rng)
    line = np.linspace(-1.0, 1.0, TERRAIN)
    x, y = np.meshgrid(line, line, indexing="ij")
    bottom = np.full_like(heights, heights.min() - 0.03)
    return [(slab(np.stack([x, y, heights], -1), np.stack([x, y, bottom], -1)), 0)]


def _terrain_space(p: np.ndarray, rng: np.random.Generator) -> Standing:
    heights = _terrain_heights(p, rng)
    return Standing(np.array([-1.0, -1.0, heights.min()]), np.array([1.0, 1.0, np.inf]), heights)


SURROUNDINGS: dict[str, Surrounding] = {
    "floor": Surrounding(floor, upright=True, roles=("ground",), seeded=False),
    "cobbles": Surrounding(cobbles, upright=True, roles=("stone",)),
    "table_top": Surrounding(
        table_top,
        upright=True,
        roles=("wood",),
        standing=_table_space,
    ),
    "round_table": Surrounding(
        round_table,
        upright=True,
        roles=("wood", "wood"),
        standing=lambda _p, _rng: _over((0.68, 0.68), 0.0),
    ),
    "backdrop": Surrounding(backdrop, upright=True, roles=("plaster",), standing=_backdrop_space),
    "room_shell": Surrounding(
        room_shell, upright=True, roles=("plaster", "wood", "plaster", "wood"), standing=_room_space
    ),
    "terrain": Surrounding(terrain, upright=True, roles=("ground",), standing=_terrain_space),
}
