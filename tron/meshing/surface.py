"""The surface of a scene as triangles: depths of many views fused, and where the field of distances is zero.

Marching cubes find the triangles (Lewiner et al. 2003, in scikit-image), and quadric errors say which of them
can go (Garland and Heckbert 1997, fast-simplification).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.relighting.proxy import seen_by
from tron.tracing.fusion import DepthMap, DistanceField, empty_rays, fuse, pixel_footprint
from tron.tracing.tracer import SurfelTracer
from tron.trajectories import film_around, film_with

VIEWS = 96
SIDE = 384
"""Views of a scene, and pixels of their longer side."""
VOXELS = 192
"""Of the grid, along the longest side of what is seen."""
TRUNCATION = 3.0
"""Voxels at which distances are cut off."""
_SOLID = 0.5
_PITS, _SMOOTHED = 3, 1.5
"""Voxels up to which holes of a scan are closed, and its distances smoothed: its depths wander."""
_WITNESSES = 3.0
"""Views that must know a voxel: one alone may look through a gap between surfels."""
_SMALLEST = 0.002
"""Share of all triangles below which a piece is left out: floaters."""

Track = Callable[[Sequence[Camera]], Iterable[Camera]]


class Triangles(NamedTuple):
    """A surface.

    Attributes:
        vertices, normals: (V, 3) float64, world; unit normals point outside.
        faces: (F, 3) int32.
        voxel: of the grid that they were found in, world units.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    voxel: float


def views_of(scene: GaussianScene, cameras: Sequence[Camera] | None = None) -> list[Camera]:
    """Cameras that see all of a scene: some of those of its photos, or a spiral around it, z up."""
    return film_around(scene, VIEWS, SIDE) if cameras is None else film_with(cameras, VIEWS, SIDE)


def surface_of(
    tracer: SurfelTracer,
    cameras: Sequence[Camera],
    *,
    voxels: int = VOXELS,
    triangles: int = 60_000,
    track: Track = iter,
) -> Triangles:
    """The surface that cameras see. What no camera has seen is open: the surface ends there.

    Args:
        tracer: the scene.
        cameras: from all sides.
        voxels: of the grid, along the longest side of what they see.
        triangles: at most so many are kept.
        track: wraps the loop over cameras, to show progress.

    Raises:
        TronError: the cameras see no surface.
    """
    from fast_simplification import simplify

    maps = [_depths(tracer, camera) for camera in track(cameras)]
    field = fuse(maps, pixel_footprint(maps), TRUNCATION, voxels)
    if field is None:
        raise TronError("the views see no surface")
    vertices, faces = _zero(field if tracer.scene.oriented else field.closed(_PITS).smoothed(_SMOOTHED))
    faces = _without_floaters(faces, len(vertices))
    if not len(faces):
        raise TronError("the views agree on no surface: it is all in small pieces")
    kept = triangles / len(faces)
    if kept < 1:
        vertices, faces = simplify(vertices.astype(np.float64), faces, target_reduction=1 - kept)[:2]
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    vertices = field.low + field.voxel * vertices[used].astype(np.float64)
    return Triangles(vertices, vertex_normals(vertices, faces), faces, field.voxel)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit means of the triangles' normals, by area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], np.cross(b - a, c - a))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _depths(tracer: SurfelTracer, camera: Camera) -> DepthMap:
    view = seen_by(tracer, camera)
    images = view.images({"depth": view.depth, "opacity": view.opacity})
    subject = images["opacity"] > _SOLID
    return DepthMap(camera, images["depth"], subject & (images["depth"] > 0), empty_rays(subject))


def _zero(field: DistanceField) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), in voxels, and faces (F, 3) where a field is zero and known."""
    from skimage.measure import marching_cubes

    known = field.weight >= _WITNESSES
    for axis in range(3):  # all corners of a cell; scikit-image asks the highest
        known = known & np.roll(known, 1, axis)
    try:
        vertices, faces, _, _ = marching_cubes(field.value, 0.0, mask=known)
    except (RuntimeError, ValueError) as error:  # nothing crosses zero
        raise TronError("the views agree on no surface") from error
    return vertices, faces


def _without_floaters(faces: np.ndarray, vertices: int) -> np.ndarray:
    """The triangles of pieces that are large enough."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges), bool), edges.T), shape=(vertices, vertices))
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    return faces[np.bincount(piece)[piece] >= max(_SMALLEST * len(faces), 1)]
