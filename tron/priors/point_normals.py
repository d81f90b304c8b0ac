"""Normals of a point cloud, from the points' neighbours and from where the cameras stood."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from tron.cameras import Camera
from tron.errors import TronError

_WITNESSES = 8  # nearest cameras that are asked which side they see
_BATCH = 1 << 17


def estimate_point_normals(points: np.ndarray, cameras: Sequence[Camera], neighbours: int = 16) -> np.ndarray:
    """Unit normals of points on surfaces, on the side that cameras see.

    The normal is the direction in which a point's neighbourhood extends least: the last principal axis of its
    ``neighbours`` nearest points (Hoppe et al. 1992, "Surface Reconstruction from Unorganized Points"). Its
    sign is the vote of the eight nearest cameras that have the point in their picture, the nearer the more
    weight; the nearest camera decides where none has. Occlusion is not tested: thin walls seen from both
    sides can come out either way.

    Args:
        points: (N, 3) world.
        cameras: at least one.
        neighbours: at least 3, the point itself not counted.

    Returns:
        (N, 3) float32, world.

    Raises:
        TronError: no cameras, fewer than four points, or points that are not finite (N, 3).
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise TronError(f"points must be finite (N, 3), not {points.shape}")
    if len(points) < 4 or neighbours < 3:
        raise TronError(
            f"{len(points)} points with {neighbours} neighbours have no normals", mend="give more"
        )
    if not cameras:
        raise TronError("normals of points need cameras to face", mend="give those of the capture")
    tree = KDTree(points)
    normals = np.empty((len(points), 3))
    for start in range(0, len(points), _BATCH):
        part = slice(start, start + _BATCH)
        near = points[tree.query(points[part], k=min(neighbours + 1, len(points)))[1]]
        centred = near - near.mean(axis=1, keepdims=True)
        normals[part] = np.linalg.eigh(centred.transpose(0, 2, 1) @ centred)[1][..., 0]
    towards = _towards_cameras(points, cameras)
    return (normals * np.where((normals * towards).sum(1, keepdims=True) < 0, -1, 1)).astype(np.float32)


def _towards_cameras(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """(N, 3) sum of the unit directions to the witnesses, divided by their distances."""
    positions = np.stack([camera.position for camera in cameras])
    count = min(_WITNESSES, len(cameras))
    asked = KDTree(positions).query(points, k=count)[1].reshape(len(points), count)
    votes = np.zeros_like(points)
    for i, camera in enumerate(cameras):
        rows = np.flatnonzero((asked == i).any(axis=1))
        pixels, depth = camera.project(points[rows])
        inside = (
            (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
        )
        away = camera.position - points[rows[inside]]
        votes[rows[inside]] += away / np.maximum((away**2).sum(axis=1, keepdims=True), 1e-12)
    alone = ~votes.any(axis=1)
    votes[alone] = positions[asked[alone, 0]] - points[alone]
    return votes
