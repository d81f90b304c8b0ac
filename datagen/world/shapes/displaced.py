"""Solids shaped by noise: a sphere moved in and out along its radii, and level sets of noise inside a body.

A radius that stays positive in every direction gives a surface that never meets itself; a level set is its
largest connected piece.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from manifold3d import Manifold

from datagen.world.shapes.shape import Kind
from datagen.world.shapes.solids import Noise, Parts, between, count, largest, tube

SPHERE = 144
"""Segments of a full circle of the sphere that is displaced."""

EDGE = 0.085
"""Edge length of the level set's triangles; bodies are about 2 wide."""

_REACH = 1.25
_CELLS = 56


def _displaced(radius: Callable[[np.ndarray], np.ndarray]) -> Manifold:
    """Solid of a radius in each unit direction (N, 3) -> (N,)."""

    def move(vertices: np.ndarray) -> np.ndarray:
        directions = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
        return directions * np.maximum(radius(directions), 0.05)[:, None]

    return Manifold.sphere(1.0, SPHERE).warp_batch(move)


def rock(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Ball broken along random planes, then roughened by fractal noise."""
    noise = Noise(rng, octaves=6, gain=0.5)
    normals = rng.standard_normal((count(p[0], 6, 16), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    distance = rng.uniform(0.55, 0.95, len(normals))
    roughness = between(p[1], 0.02, 0.06)

    def radius(directions: np.ndarray) -> np.ndarray:
        facing = directions @ normals.T
        broken = np.where(facing > 0.05, distance / np.maximum(facing, 0.05), 1.0).min(axis=1)
        return np.minimum(broken, 1.0) + roughness * noise(directions * 1.6)

    return [(_displaced(radius).scale((1.0, between(p[2], 0.65, 1.0), between(p[3], 0.45, 0.9))), 0)]


def pebble(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Flattened ball, worn smooth."""
    noise = Noise(rng, octaves=2, gain=0.3)
    swell = between(p[0], 0.04, 0.12)
    solid = _displaced(lambda directions: 1.0 + swell * noise(directions * 0.8))
    return [(solid.scale((1.0, between(p[1], 0.6, 0.95), between(p[2], 0.3, 0.65))), 0)]


def fruit(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Apple to pear: dimples at the poles, a waist, a little noise, and a stem."""
    noise = Noise(rng, octaves=2, gain=0.4)
    dimple, pear, lobes = between(p[0], 0.1, 0.35), between(p[1], -0.1, 0.45), count(p[2], 3, 6)

    def radius(directions: np.ndarray) -> np.ndarray:
        polar = np.arccos(np.clip(directions[:, 2], -1.0, 1.0))
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        poles = np.exp(-((polar / 0.45) ** 2)) + 0.7 * np.exp(-(((np.pi - polar) / 0.35) ** 2))
        # A pear is drawn out upwards and narrow where its neck begins.
        waist = pear * (0.55 * np.exp(-((polar / 0.7) ** 2)) - 0.3 * np.exp(-(((polar - 1.15) / 0.45) ** 2)))
        ribs = 0.03 * np.cos(lobes * azimuth) * np.sin(0.5 * polar) ** 4 * np.sin(polar)
        return 1.0 - dimple * poles + waist + ribs + 0.02 * noise(directions)

    body = _displaced(radius)
    top = float(radius(np.array([[0.0, 0.0, 1.0]]))[0])
    lean = rng.uniform(-0.25, 0.25, 2)
    t = np.linspace(0.0, 1.0, 12)[:, None]
    stem = np.concatenate([lean * t**2, top - 0.1 + (0.35 + 0.25 * p[3]) * t], axis=1)
    return [(body, 0), (tube(stem, np.linspace(0.045, 0.06, 12), sections=10), 1)]


def pumpkin(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Ribbed, flattened and dented at the poles, with a thick bent stem."""
    noise = Noise(rng, octaves=3, gain=0.4)
    ribs, depth = count(p[0], 8, 14), between(p[1], 0.08, 0.2)

    def radius(directions: np.ndarray) -> np.ndarray:
        flat = np.hypot(directions[:, 0], directions[:, 1])
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        groove = 1.0 - np.abs(np.cos(0.5 * ribs * azimuth))
        dent = 0.4 * np.exp(-((flat / 0.35) ** 2))
        return 1.0 - depth * groove**2 * flat - dent + 0.02 * noise(directions)

    height = between(p[2], 0.65, 0.95)
    body = _displaced(radius).scale((1.0, 1.0, height))
    t = np.linspace(0.0, 1.0, 16)[:, None]
    turn = rng.uniform(0.0, 2 * np.pi)
    bend = np.array([np.cos(turn), np.sin(turn)]) * between(p[3], 0.05, 0.3)
    stem = np.concatenate([bend * t**2, 0.6 * height - 0.1 + 0.55 * t], axis=1)
    return [(body, 0), (tube(stem, np.linspace(0.13, 0.08, 16), sections=7), 1)]


def _level_set(inside: Callable[[np.ndarray], np.ndarray]) -> Manifold:
    """Surface ``inside = 0`` within the cube of half side 1.2, its largest component.

    manifold3d asks for one point after another, too slow for noise: a grid is filled first and looked up.
    """
    line = np.linspace(-_REACH, _REACH, _CELLS)
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    values = inside(points).reshape((_CELLS,) * 3)
    step = line[1] - line[0]
    grid = values.tolist()

    def sample(x: float, y: float, z: float) -> float:
        u, v, w = (x + _REACH) / step, (y + _REACH) / step, (z + _REACH) / step
        i, j, k = min(int(u), _CELLS - 2), min(int(v), _CELLS - 2), min(int(w), _CELLS - 2)
        u, v, w = u - i, v - j, w - k
        near, far = grid[i], grid[i + 1]
        a, b, c, d = near[j], near[j + 1], far[j], far[j + 1]
        low = (a[k] * (1 - w) + a[k + 1] * w) * (1 - v) + (b[k] * (1 - w) + b[k + 1] * w) * v
        high = (c[k] * (1 - w) + c[k + 1] * w) * (1 - v) + (d[k] * (1 - w) + d[k + 1] * w) * v
        return low * (1 - u) + high * u

    return largest(Manifold.level_set(sample, [-1.2, -1.2, -1.2, 1.2, 1.2, 1.2], EDGE))


def _body(p: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Depth inside a superquadric between a ball and a rounded box; positive inside."""
    exponent = between(p[2], 2.0, 6.0)
    scale = (1.0, between(p[3], 0.75, 1.0), between(p[3], 1.0, 0.7))
    return 1.0 - (np.abs(points / scale) ** exponent).sum(axis=1) ** (1.0 / exponent)


def sponge(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Body eaten by round holes: tuff, pumice, driftwood, cheese."""
    noise = Noise(rng, octaves=2, gain=0.35)
    frequency, share = between(p[0], 1.2, 2.0), between(p[1], 0.7, 1.3)
    return [
        (
            _level_set(
                lambda points: np.minimum(_body(p, points), 0.15 * (noise(points * frequency) + share))
            ),
            0,
        )
    ]


def coral(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Sheets and bridges where noise is near zero, about a solid heart so that they hang together."""
    noise = Noise(rng, octaves=1)
    frequency, width = between(p[0], 0.9, 1.5), between(p[1], 0.45, 0.7)

    def inside(points: np.ndarray) -> np.ndarray:
        heart = 0.45 - np.linalg.norm(points, axis=1)
        sheets = 0.25 * (width - np.abs(noise(points * frequency)))
        return np.maximum(heart, np.minimum(_body(p, points), sheets))

    return [(_level_set(inside), 0)]


DISPLACED: dict[str, Kind] = {
    "rock": Kind(rock, roles=("stone",)),
    "pebble": Kind(pebble, roles=("stone",)),
    "fruit": Kind(fruit, roles=("any", "bark")),
    "pumpkin": Kind(pumpkin, upright=True, roles=("any", "bark")),
    "sponge": Kind(sponge, roles=("stone",)),
    "coral": Kind(coral, roles=("any",)),
}
