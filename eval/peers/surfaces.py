"""Closed-form surfaces on the unit square: every map preserves area, so even points stay even.

One definition serves both forms of the benchmark's scene (:mod:`eval.peers.scene`): surfels stand where a
low-discrepancy sequence falls, and the triangles of the equivalent mesh join a lattice of the same map.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass

import numpy as np


class Surface(abc.ABC):
    """A surface parametrised by (u, v) in [0, 1]^2; equal areas of the square stay equal in the world."""

    @property
    @abc.abstractmethod
    def area(self) -> float:
        """Area in world units squared."""

    @abc.abstractmethod
    def at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and outward unit normals, two (N, 3) float64 arrays, world."""

    @abc.abstractmethod
    def patches(self, fineness: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Lattices (u, v), 1D each and ascending, whose quads cover the surface."""

    def mesh(self, fineness: int = 96) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Triangles of the surface: vertices (V, 3), vertex normals (V, 3), faces (F, 3) wound outwards."""
        vertices, normals, faces = [], [], []
        offset = 0
        for u, v in self.patches(fineness):
            grid_u, grid_v = (a.ravel() for a in np.meshgrid(u, v, indexing="ij"))
            points, directions = self.at(grid_u, grid_v)
            corner = np.arange(len(u) * len(v)).reshape(len(u), len(v)) + offset
            a, b, c, d = (
                q.ravel() for q in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:])
            )
            faces.append(np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
            vertices.append(points)
            normals.append(directions)
            offset += corner.size
        points, directions, triangles = map(np.concatenate, (vertices, normals, faces))
        return points, directions, _wound_outwards(points, directions, triangles)


def _wound_outwards(points: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Turn triangles whose winding disagrees with their vertex normals; drop those without an area."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    faces = np.where(((cross * normals[faces].sum(1)).sum(1) < 0)[:, None], faces[:, [0, 2, 1]], faces)
    return faces[np.linalg.norm(cross, axis=1) > 1e-12]


@dataclass(frozen=True)
class Floor(Surface):
    """The square |x|, |y| <= half in the plane z = 0, seen from above."""

    half: float

    @property
    def area(self) -> float:
        """Area in world units squared."""
        return 4 * self.half**2

    def at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and normals."""
        points = np.stack([(2 * u - 1) * self.half, (2 * v - 1) * self.half, np.zeros_like(u)], 1)
        return points, np.tile([0.0, 0.0, 1.0], (len(u), 1))

    def patches(self, fineness: int) -> list[tuple[np.ndarray, np.ndarray]]:  # noqa: ARG002 (flat)
        """One quad."""
        return [(np.array([0.0, 1.0]), np.array([0.0, 1.0]))]


@dataclass(frozen=True)
class Sphere(Surface):
    """A sphere; u is longitude, v runs evenly in height (Archimedes: that preserves area)."""

    centre: tuple[float, float, float]
    radius: float

    @property
    def area(self) -> float:
        """Area in world units squared."""
        return 4 * np.pi * self.radius**2

    def at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and normals."""
        z = 1 - 2 * v
        ring = np.sqrt(np.maximum(1 - z * z, 0))
        normals = np.stack([ring * np.cos(2 * np.pi * u), ring * np.sin(2 * np.pi * u), z], 1)
        return np.array(self.centre) + self.radius * normals, normals

    def patches(self, fineness: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Even in the polar angle, so that the poles are as fine as the equator."""
        polar = np.linspace(0, np.pi, fineness // 2 + 1)
        return [(np.linspace(0, 1, fineness + 1), (1 - np.cos(polar)) / 2)]


@dataclass(frozen=True)
class Torus(Surface):
    """A lying torus; u runs around its axis, v around the tube at a pace that preserves area."""

    centre: tuple[float, float, float]
    major: float
    minor: float

    @property
    def area(self) -> float:
        """Area in world units squared."""
        return 4 * np.pi**2 * self.major * self.minor

    def _share(self, angle: np.ndarray) -> np.ndarray:
        """Share of the area below a tube angle: the integral of (R + r cos b) / (2 pi R)."""
        return (self.major * angle + self.minor * np.sin(angle)) / (2 * np.pi * self.major)

    def at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and normals."""
        table = np.linspace(0, 2 * np.pi, 8193)
        tube, around = np.interp(v, self._share(table), table), 2 * np.pi * u
        outwards = np.stack([np.cos(around), np.sin(around), np.zeros_like(u)], 1)
        normals = outwards * np.cos(tube)[:, None] + np.array([0, 0, 1.0]) * np.sin(tube)[:, None]
        return np.array(self.centre) + self.major * outwards + self.minor * normals, normals

    def patches(self, fineness: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Even in the tube angle."""
        return [(np.linspace(0, 1, fineness + 1), self._share(np.linspace(0, 2 * np.pi, fineness // 2 + 1)))]


@dataclass(frozen=True)
class Box(Surface):
    """A cube along the axes; u picks the face, and what is left of it a place along the face.

    ``inwards`` it is a room: its normals point to the middle.
    """

    centre: tuple[float, float, float]
    half: float
    inwards: bool = False

    @property
    def area(self) -> float:
        """Area in world units squared."""
        return 24 * self.half**2

    def at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and normals."""
        face = np.minimum((u * 6).astype(int), 5)
        row, axis = np.arange(len(u)), face // 2
        normals = np.zeros((len(u), 3))
        normals[row, axis] = np.where(face % 2, 1.0, -1.0)
        points = normals.copy()
        points[row, (axis + 1) % 3] = 2 * (u * 6 - face) - 1
        points[row, (axis + 2) % 3] = 2 * v - 1
        return np.array(self.centre) + self.half * points, -normals if self.inwards else normals

    def patches(self, fineness: int) -> list[tuple[np.ndarray, np.ndarray]]:  # noqa: ARG002 (flat)
        """One quad a face; the faces' upper ends stay a hair inside their strip of u."""
        return [(np.array([k, k + 1 - 1e-9]) / 6, np.array([0.0, 1.0])) for k in range(6)]
