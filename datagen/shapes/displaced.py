"""Displaced solids: rocks, pebbles, fruit and pumpkins, a sphere moved in and out along its radii.

A radius that stays positive in every direction gives a surface that never meets itself.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from manifold3d import Manifold

from datagen.shapes.noise import Noise
from datagen.shapes.shape import Kind
from datagen.shapes.solids import Parts, between, count, tube

SPHERE = 144
"""Segments of a full circle of the sphere that is displaced."""


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


DISPLACED: dict[str, Kind] = {
    "rock": Kind(rock, roles=("stone",)),
    "pebble": Kind(pebble, roles=("stone",)),
    "fruit": Kind(fruit, roles=("any", "bark")),
    "pumpkin": Kind(pumpkin, upright=True, roles=("any", "bark")),
}
