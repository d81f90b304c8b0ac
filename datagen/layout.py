"""Places of objects: at rest on the floor z = 0, apart from each other, or left out.

Objects are settled one by one and moved about until nothing touches; collisions are exact tests of convex
hulls (FCL). Tries are bounded: an object that finds no place is left out and named.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation
from trimesh import Trimesh
from trimesh.collision import CollisionManager

from datagen.spec import Number, Spec, Triple

TRIES = 60
SUPPORTS = 256
GAP = 0.03
"""Least distance in world units between two objects' hulls: below it, surfels of one would touch the other.
"""


class Placement(Spec):
    """A rigid motion from an object's frame to the world.

    Attributes:
        quaternion: (w, x, y, z), of any length but zero.
        position: (3,) world, where the object's origin goes.
    """

    quaternion: tuple[Number, Number, Number, Number]
    position: Triple

    def matrix(self) -> np.ndarray:
        """(4, 4) float64 object-to-world."""
        matrix = np.eye(4)
        w, x, y, z = self.quaternion
        matrix[:3, :3] = Rotation.from_quat((x, y, z, w)).as_matrix()
        matrix[:3, 3] = self.position
        return matrix

    def moved(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) world points from the object's (N, 3)."""
        matrix = self.matrix()
        return points @ matrix[:3, :3].T + matrix[:3, 3]


def place(
    rng: np.random.Generator,
    meshes: Sequence[Trimesh],
    radius: float,
    *,
    upright: Sequence[bool] | None = None,
) -> list[Placement | None]:
    """Put meshes on the floor within ``radius`` of the origin, none nearer than GAP to another.

    Args:
        rng: source of orientations and positions.
        meshes: each in its own frame, world units.
        radius: objects' origins keep within this disk, world units.
        upright: True for an object that only turns about z (it was modelled standing); False for one that is
            dropped in a random orientation and settles on a face. None means all False.

    Returns:
        One placement a mesh, in order; None where TRIES positions were all taken.
    """
    standing: list[_Body] = []
    placements: list[Placement | None] = []
    for i, mesh in enumerate(meshes):
        hull = mesh.convex_hull
        coarse = support_hull(hull)
        stays = upright is not None and upright[i]
        turn = np.eye(3) if stays else settle(hull, Rotation.random(rng=rng).as_matrix())
        turn = Rotation.from_euler("z", rng.uniform(0.0, 2 * np.pi)).as_matrix() @ turn
        floor = -float((np.asarray(hull.vertices) @ turn.T)[:, 2].min())
        placements.append(None)
        for _ in range(TRIES):
            x, y = _in_disk(rng, radius)
            candidate = _placement(turn, (x, y, floor))
            body = _Body(coarse, candidate.matrix())
            if all(body.is_apart_from(other) for other in standing):
                standing.append(body)
                placements[-1] = candidate
                break
    return placements


class _Body:
    """A convex hull where it stands, between a ball that holds it and a ball that it holds."""

    def __init__(self, hull: Trimesh, matrix: np.ndarray):
        self.hull, self.matrix = hull, matrix
        inner = np.asarray(hull.center_mass)
        self.centre = matrix[:3, :3] @ inner + matrix[:3, 3]
        self.outer_radius = float(np.linalg.norm(np.asarray(hull.vertices) - inner, axis=1).max())
        self.inner_radius = float(_face_distances(hull, inner).min())

    def is_apart_from(self, other: _Body) -> bool:
        """Whether more than GAP lies between the hulls; the balls answer most questions before FCL has to."""
        distance = float(np.linalg.norm(self.centre - other.centre))
        if distance > self.outer_radius + other.outer_radius + GAP:
            return True
        if distance < self.inner_radius + other.inner_radius + GAP:
            return False
        manager = CollisionManager()
        manager.add_object("other", other.hull, other.matrix)
        return float(manager.min_distance_single(self.hull, self.matrix)) > GAP  # type: ignore[arg-type]


def support_hull(hull: Trimesh) -> Trimesh:
    """Hull of the outermost points in SUPPORTS directions.

    It is exact for boxes and within GAP / 4 for balls of size 1. FCL's distance takes time in proportion to
    the faces, and curved bodies have thousands.
    """
    k = np.arange(SUPPORTS) + 0.5
    z, angle = 1.0 - 2.0 * k / SUPPORTS, k * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    vertices = np.asarray(hull.vertices)
    chosen = np.unique((directions @ vertices.T).argmax(axis=1))
    return Trimesh(vertices[chosen]).convex_hull if len(chosen) >= 4 else hull


def _face_distances(hull: Trimesh, point: np.ndarray) -> np.ndarray:
    """(F,) distance of a point inside a convex body from the plane of each face."""
    return ((np.asarray(hull.triangles_center) - point) * np.asarray(hull.face_normals)).sum(axis=1)


def settle(hull: Trimesh, rotation: np.ndarray) -> np.ndarray:
    """Roll a convex body from an orientation to the stable face it comes to rest on.

    The body tips over the face under its centre of mass until that face is the one below: each roll lowers
    the centre of mass, so this ends. Returns the (3, 3) rotation at rest.
    """
    normals = np.asarray(hull.face_normals, dtype=np.float64)
    heights = _face_distances(hull, np.asarray(hull.center_mass))
    down = rotation.T @ (0.0, 0.0, -1.0)
    lowest = np.inf
    while True:
        facing = normals @ down
        reach = np.where(facing > 1e-9, heights / np.maximum(facing, 1e-9), np.inf)
        face = int(reach.argmin())
        if heights[face] >= lowest - 1e-9:
            break
        lowest = float(heights[face])
        down = normals[face]
    turn = Rotation.align_vectors([[0.0, 0.0, -1.0]], [rotation @ down])[0]
    return turn.as_matrix() @ rotation


def _in_disk(rng: np.random.Generator, radius: float) -> tuple[float, float]:
    distance, angle = radius * np.sqrt(rng.random()), rng.uniform(0.0, 2 * np.pi)
    return distance * np.cos(angle), distance * np.sin(angle)


def _placement(turn: np.ndarray, position: tuple[float, float, float]) -> Placement:
    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    return Placement(quaternion=with_one_sign((w, x, y, z)), position=position)


def with_one_sign(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Of two quaternions that are one turn, that whose first component beyond a rounding is positive.

    Of half a turn w is a rounding to either side of 0, another one on each processor, and decides nothing.
    """
    w, x, y, z = quaternion
    rounding = 1e-3 * max(abs(part) for part in quaternion)
    if next(part for part in quaternion if abs(part) > rounding) > 0:
        return w, x, y, z
    return -w, -x, -y, -z
