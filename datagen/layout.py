"""Where objects stand: at rest on the floor z = 0, apart from each other, or not at all.

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
    manager = CollisionManager()
    placements: list[Placement | None] = []
    for i, mesh in enumerate(meshes):
        hull = mesh.convex_hull
        stays = upright is not None and upright[i]
        turn = np.eye(3) if stays else settle(hull, Rotation.random(rng=rng).as_matrix())
        turn = Rotation.from_euler("z", rng.uniform(0.0, 2 * np.pi)).as_matrix() @ turn
        floor = -float((np.asarray(hull.vertices) @ turn.T)[:, 2].min())
        found: Placement | None = None
        for _ in range(TRIES):
            x, y = _in_disk(rng, radius)
            candidate = _placement(turn, (x, y, floor))
            if not placements or _distance(manager, hull, candidate) > GAP:
                found = candidate
                break
        if found is not None:
            manager.add_object(f"object{i}", hull, found.matrix())
        placements.append(found)
    return placements


def settle(hull: Trimesh, rotation: np.ndarray) -> np.ndarray:
    """Roll a convex body from an orientation to the stable face it comes to rest on.

    The body tips over the face under its centre of mass until that face is the one below: each roll lowers
    the centre of mass, so this ends. Returns the (3, 3) rotation at rest.
    """
    normals = np.asarray(hull.face_normals, dtype=np.float64)
    centre = np.asarray(hull.center_mass)
    # Distance from the centre of mass to each face's plane.
    heights = ((np.asarray(hull.triangles_center) - centre) * normals).sum(axis=1)
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


def _distance(manager: CollisionManager, hull: Trimesh, placement: Placement) -> float:
    return float(manager.min_distance_single(hull, placement.matrix()))  # type: ignore[arg-type]


def _in_disk(rng: np.random.Generator, radius: float) -> tuple[float, float]:
    distance, angle = radius * np.sqrt(rng.random()), rng.uniform(0.0, 2 * np.pi)
    return distance * np.cos(angle), distance * np.sin(angle)


def _placement(turn: np.ndarray, position: tuple[float, float, float]) -> Placement:
    x, y, z, w = Rotation.from_matrix(turn).as_quat(canonical=True)
    return Placement(quaternion=(w, x, y, z), position=position)
