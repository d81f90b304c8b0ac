"""Plants: leaves on stems, branches and in pots, with a thickness or without; tufts of grass."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold
from scipy.spatial.transform import Rotation

from datagen.world.shapes.shape import Kind
from datagen.world.shapes.solids import (
    Parts,
    between,
    count,
    layers,
    rod,
    sheet,
    smooth_profile,
    tube,
    turned,
    union,
    vessel,
)

GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
"""Angle between one leaf and the next around a stem (phyllotaxis)."""


def blade(
    length: float, width: float, droop: float, fold: float, grid: tuple[int, int] = (15, 7)
) -> np.ndarray:
    """Grid (n, m, 3) of a leaf from the origin along x, its upper side towards z: pointed, folded, bent down.

    Args:
        length, width: of the blade.
        droop: angle in radians by which the tip is lower than the base.
        fold: angle in radians by which each half rises from the midrib.
        grid: points along and across it; across an odd number.
    """
    n, m = grid
    t, u = np.meshgrid(np.linspace(0.0, 1.0, n), np.linspace(-1.0, 1.0, m), indexing="ij")
    half = 0.5 * width * (np.sin(np.pi * t**0.75) ** 0.8 * (1.0 - 0.12 * t) + 0.04)
    angle = droop * np.linspace(0.0, 1.0, n)
    step = length / (n - 1)
    x = np.concatenate([[0.0], np.cumsum(step * np.cos(angle[1:]))])
    z = -np.concatenate([[0.0], np.cumsum(step * np.sin(angle[1:]))])
    lift = np.abs(u) * half * np.sin(fold)
    return np.stack(
        [x[:, None] + lift * np.sin(angle)[:, None], u * half * np.cos(fold), z[:, None] + lift], -1
    )


def leaf(
    length: float, width: float, droop: float, fold: float, thickness: float, grid: tuple[int, int] = (15, 7)
) -> Manifold:
    """Leaf of a thickness about a :func:`blade`."""
    return sheet(blade(length, width, droop, fold, grid), thickness)


def _turn(azimuth: float, rise: float, roll: float = 0.0) -> np.ndarray:
    return Rotation.from_euler("ZYX", [azimuth, -rise, roll]).as_matrix()


def _placed(solid: Manifold, at: np.ndarray, azimuth: float, rise: float, roll: float = 0.0) -> Manifold:
    return solid.transform(np.column_stack([_turn(azimuth, rise, roll), at]))


def _potted(p: np.ndarray, rng: np.random.Generator) -> tuple[Parts, list[tuple[np.ndarray, np.ndarray]]]:
    """Pot with soil and stems that lean outwards; a blade and where it goes (3, 4) for each of its leaves."""
    high = between(p[0], 0.6, 0.95)
    pot = vessel(smooth_profile([0.0, 0.8 * high, 0.81 * high, high], [0.42, 0.6, 0.68, 0.7], 40), 0.06)
    soil = turned(
        np.array([[0.5, 0.5 * high], [0.56, 0.84 * high], [0.3, 0.87 * high], [0.02, 0.89 * high]]), 40
    )
    stems, leaves = [], []
    long, slim = between(p[1], 0.5, 1.0), between(p[2], 0.3, 0.7)
    number = count(p[3], 3, 6)
    for s in range(number):
        azimuth = 2 * np.pi * (s + 0.6 * rng.random()) / number
        lean, tall = rng.uniform(0.15, 0.7), rng.uniform(0.9, 1.9)
        t = np.linspace(0.0, 1.0, 14)
        out = 0.15 + lean * t**1.5
        path = np.column_stack([out * np.cos(azimuth), out * np.sin(azimuth), 0.7 * high + tall * t])
        stems.append(tube(path, np.linspace(0.035, 0.014, 14), sections=8))
        for k in range(int(rng.integers(5, 9))):
            place = 0.35 + 0.65 * (k + 1) / 9
            at = np.array([np.interp(place, t, path[:, d]) for d in range(3)])
            size = long * rng.uniform(0.7, 1.1) * (1.15 - 0.5 * place)
            points = blade(size, slim * size, rng.uniform(0.4, 1.3), rng.uniform(0.1, 0.4))
            turn = _turn(azimuth + k * GOLDEN, rng.uniform(0.0, 0.9), rng.normal(0, 0.2))
            leaves.append((points, np.column_stack([turn, at])))
    return [(pot, 0), (soil, 1), (union(stems), 2)], leaves


def plant(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Potted plant, its leaves around each stem in the golden angle."""
    parts, leaves = _potted(p, rng)
    return [*parts, (union([sheet(points, 0.012).transform(place) for points, place in leaves]), 3)]


def foliage(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """The same whose leaves are layers without a thickness."""
    parts, leaves = _potted(p, rng)
    return [*parts, (layers([points @ place[:, :3].T + place[:, 3] for points, place in leaves]), 3)]


def branch(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Crooked twig that lies on the ground, with side twigs and leaves."""
    steps = 24
    bend = np.cumsum(rng.normal(0.0, between(p[0], 0.05, 0.14), (steps, 2)), axis=0)
    direction = np.column_stack([np.ones(steps), bend[:, 0], 0.5 * bend[:, 1]])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(direction * 2.6 / steps, axis=0)])
    wood = [tube(path, np.linspace(0.07, 0.02, steps + 1), sections=10)]
    leaves = []
    long, slim = between(p[1], 0.28, 0.5), between(p[2], 0.35, 0.65)
    for k in range(count(p[3], 5, 9)):
        at = path[5 + 2 * k]
        azimuth = (1 if k % 2 else -1) * rng.uniform(0.5, 1.1)
        rise = rng.uniform(-0.1, 0.5)
        out = np.array([np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)])
        reach = rng.uniform(0.35, 0.75)
        wood.append(rod(at, at + reach * out, 0.025, 0.012, sections=7))
        for j in range(4):
            share = 0.4 + 0.2 * j
            side = azimuth + (0.9 if j % 2 else -0.9) * (j < 3)
            size = long * rng.uniform(0.75, 1.1)
            blade = leaf(size, slim * size, rng.uniform(0.2, 0.9), rng.uniform(0.1, 0.35), 0.01)
            leaves.append(
                _placed(blade, at + share * reach * out, side, rng.uniform(-0.1, 0.6), rng.normal(0, 0.3))
            )
    return [(union(wood), 0), (union(leaves), 1)]


def grass(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Tuft of blades that bend outwards from one root."""
    blades = []
    for k in range(count(p[0], 24, 44)):
        spread = np.sqrt(rng.random()) * between(p[1], 0.15, 0.4)
        azimuth = k * GOLDEN + rng.normal(0.0, 0.2)
        at = np.array([spread * np.cos(azimuth), spread * np.sin(azimuth), 0.0])
        blade = leaf(rng.uniform(0.7, 1.4), between(p[2], 0.05, 0.11), rng.uniform(0.3, 1.6), 0.25, 0.01)
        rise = rng.uniform(1.1, 1.5) - 0.4 * p[3]
        blades.append(_placed(blade, at, azimuth, rise))
    return [(union(blades), 0)]


def tree(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Small tree: a trunk that forks, and clumps of leaves at the ends of its boughs."""
    boughs = count(p[0], 5, 8)
    trunk_height = between(p[1], 0.9, 1.5)
    t = np.linspace(0.0, 1.0, 10)
    sway = rng.normal(0.0, 0.12, 2)
    trunk = np.column_stack([sway[0] * t**2, sway[1] * t**2, trunk_height * t])
    wood = [tube(trunk, np.linspace(0.13, 0.08, 10), sections=10)]
    leaves = []
    size = between(p[2], 0.24, 0.4)
    for b in range(boughs):
        azimuth, start = b * GOLDEN + rng.normal(0.0, 0.2), 0.55 + 0.45 * b / boughs
        root = np.array([np.interp(start, t, trunk[:, d]) for d in range(3)])
        reach, climb = rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.9)
        s = np.linspace(0.0, 1.0, 8)
        out = reach * s
        path = root + np.column_stack([out * np.cos(azimuth), out * np.sin(azimuth), climb * s**1.4])
        wood.append(tube(path, np.linspace(0.06, 0.02, 8), sections=7))
        for k in range(count(p[3], 14, 22)):
            place = 0.4 + 0.6 * rng.random()
            at = np.array([np.interp(place, s, path[:, d]) for d in range(3)])
            blade = leaf(size * rng.uniform(0.7, 1.2), size * 0.5, rng.uniform(0.2, 1.0), 0.2, 0.01, (8, 3))
            leaves.append(_placed(blade, at, k * GOLDEN, rng.uniform(-0.2, 1.0), rng.normal(0, 0.3)))
    return [(union(wood), 0), (union(leaves), 1)]


PLANTS: dict[str, Kind] = {
    "plant": Kind(plant, upright=True, roles=("ceramic", "ground", "bark", "leaf")),
    "foliage": Kind(foliage, upright=True, roles=("ceramic", "ground", "bark", "leaf")),
    "branch": Kind(branch, upright=True, roles=("bark", "leaf")),
    "grass": Kind(grass, upright=True, roles=("leaf",)),
    "tree": Kind(tree, upright=True, roles=("bark", "leaf")),
}
