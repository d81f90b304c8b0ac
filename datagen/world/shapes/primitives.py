"""Primitive solids: a closed mesh from a few proportions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from trimesh import Trimesh

from datagen.world.shapes.shape import Kind
from datagen.world.shapes.solids import between


def _sphere(_p: np.ndarray) -> Trimesh:
    return trimesh.creation.icosphere(4)


def _box(p: np.ndarray) -> Trimesh:
    return trimesh.creation.box((1.0, between(p[0], 0.6, 1.0), between(p[1], 0.4, 1.6)))


def _cylinder(p: np.ndarray) -> Trimesh:
    return trimesh.creation.cylinder(1.0, between(p[0], 0.7, 3.0), sections=48)


def _cone(p: np.ndarray) -> Trimesh:
    return trimesh.creation.cone(1.0, between(p[0], 1.4, 2.6), sections=48)


def _torus(p: np.ndarray) -> Trimesh:
    return trimesh.creation.torus(1.0, between(p[0], 0.3, 0.5), major_sections=72, minor_sections=36)


def _blob(p: np.ndarray) -> Trimesh:
    mesh = trimesh.creation.icosphere(4)
    waves = 2.0 + 3.0 * p[:3]
    vertices = np.asarray(mesh.vertices)
    mesh.vertices = vertices * (1.0 + 0.1 * np.sin(vertices * waves + 6.28 * p[3]).sum(axis=1, keepdims=True))
    return mesh


def _capsule(p: np.ndarray) -> Trimesh:
    return trimesh.creation.capsule(height=between(p[0], 0.5, 2.5), radius=1.0, count=(48, 48))


def _gem(p: np.ndarray) -> Trimesh:
    mesh = trimesh.creation.icosphere(1 if p[1] < 0.5 else 0)
    mesh.vertices = np.asarray(mesh.vertices) * (1.0, 1.0, between(p[0], 0.8, 1.5))
    return mesh


def _star(p: np.ndarray) -> Trimesh:
    """A prism over a star of 4 to 8 points."""
    points = 4 + int(p[0] * 4.999)
    n = 2 * points
    angle = np.arange(n) * 2 * np.pi / n
    radius = np.where(np.arange(n) % 2, between(p[1], 0.5, 0.75), 1.0)
    half = 0.5 * between(p[2], 0.4, 1.8)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    vertices = np.concatenate(
        [
            np.column_stack([ring, np.full(n, -half)]),
            np.column_stack([ring, np.full(n, half)]),
            [[0.0, 0.0, -half], [0.0, 0.0, half]],
        ]
    )
    i, j = np.arange(n), (np.arange(n) + 1) % n
    faces = np.concatenate(
        [
            np.column_stack([i, j, j + n]),
            np.column_stack([i, j + n, i + n]),
            np.column_stack([j, i, np.full(n, 2 * n)]),
            np.column_stack([i + n, j + n, np.full(n, 2 * n + 1)]),
        ]
    )
    return Trimesh(vertices, faces)


def _vase(p: np.ndarray) -> Trimesh:
    """A solid of revolution whose profile swells, narrows and opens."""
    t = np.linspace(0.0, 1.0, 40)
    swell, neck = between(p[0], 0.5, 0.9), between(p[1], 0.1, 0.3)
    radius = 0.35 + swell * np.sin(np.pi * t**0.8) ** 2 * (1.0 - t) + neck * t**3
    profile = np.column_stack([radius, t * between(p[2], 1.6, 2.4)])
    profile = np.concatenate([[[0.0, 0.0]], profile, [[0.0, profile[-1, 1]]]])
    return trimesh.creation.revolve(profile, sections=48)


def _knot(p: np.ndarray) -> Trimesh:
    """A tube around a (2, 3) torus knot, swept with the frame of the torus normal."""
    n, m, tube = 240, 24, between(p[0], 0.22, 0.36)
    t = np.arange(n) * 2 * np.pi / n
    centre = np.column_stack(
        [
            (1.6 + 0.7 * np.cos(3 * t)) * np.cos(2 * t),
            (1.6 + 0.7 * np.cos(3 * t)) * np.sin(2 * t),
            0.7 * np.sin(3 * t),
        ]
    )
    tangent = np.roll(centre, -1, axis=0) - np.roll(centre, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    away = np.column_stack([np.cos(2 * t), np.sin(2 * t), np.zeros(n)]) * 1.6 - centre
    first = away - tangent * (away * tangent).sum(axis=1, keepdims=True)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(tangent, first)
    angle = (np.arange(m) * 2 * np.pi / m)[None, :, None]
    rings = centre[:, None] + tube * (np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None])
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    a, b = (i * m + j).ravel(), (i * m + (j + 1) % m).ravel()
    c, d = (((i + 1) % n) * m + (j + 1) % m).ravel(), (((i + 1) % n) * m + j).ravel()
    mesh = Trimesh(
        rings.reshape(-1, 3), np.concatenate([np.column_stack([a, d, c]), np.column_stack([a, c, b])])
    )
    mesh.fix_normals()
    return mesh


def _superquadric(p: np.ndarray) -> Trimesh:
    """|x|^e + |y|^e + |z|^f = 1 by projecting a sphere: from pillows to rounded boxes."""
    mesh = trimesh.creation.icosphere(4)
    v = np.asarray(mesh.vertices)
    e, f = between(p[0], 2.5, 6.0), between(p[1], 2.5, 6.0)
    flat = (np.abs(v[:, 0]) ** e + np.abs(v[:, 1]) ** e) ** (1.0 / e)
    radius = (flat**f + np.abs(v[:, 2]) ** f) ** (-1.0 / f)
    mesh.vertices = v * radius[:, None] * (1.0, 1.0, between(p[2], 0.6, 1.4))
    return mesh


def _kind(build: Callable[[np.ndarray], Trimesh]) -> Kind:
    return Kind(lambda parameters, _rng: [(build(parameters), 0)], seeded=False)


PRIMITIVES: dict[str, Kind] = {
    "sphere": _kind(_sphere),
    "box": _kind(_box),
    "cylinder": _kind(_cylinder),
    "cone": _kind(_cone),
    "torus": _kind(_torus),
    "blob": _kind(_blob),
    "capsule": _kind(_capsule),
    "gem": _kind(_gem),
    "star": _kind(_star),
    "vase": _kind(_vase),
    "knot": _kind(_knot),
    "superquadric": _kind(_superquadric),
}
