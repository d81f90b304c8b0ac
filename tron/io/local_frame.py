"""A local origin for what stands at the coordinates of a map or of the earth.

Scenes and captures are float32 where it counts, which resolves one part in 1.7e7: half a metre in northings
of UTM or coordinates about the centre of the earth (ECEF). Their middle is taken away in float64 before
anything is rounded, and is kept as an offset: coordinates of the files = local coordinates + offset. Axes
stay what they are (conventions.md, 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tron.cameras import Camera

LARGE = 100.0
"""Distance from the origin, in extents, from which a local one is taken: float32 rounds to 6e-6 extents."""
ORIGIN = np.zeros(3)
"""The offset of what stands near its origin."""
_TRIM = 0.05
_SAMPLE = 100_000


def local_origin(points: np.ndarray, finest: float = np.inf) -> np.ndarray:
    """(3,) float64 offset for finite points (N, 3): a round number near their middle, or zero.

    Zero where they lie no further from the origin than :data:`LARGE` times their extent, the diagonal of the
    box that holds the middle nine tenths of them on each axis; or than their extent, where float32 has larger
    steps there than ``finest``, what has to be told apart.
    """
    points = np.asarray(points, np.float64)
    if not len(points):
        return np.zeros(3)
    some = points[:: max(1, len(points) // _SAMPLE)]
    low, middle, high = np.quantile(some, [_TRIM, 0.5, 1 - _TRIM], axis=0)
    extent = float(np.linalg.norm(high - low))
    away = float(np.linalg.norm(middle))
    coarse = float(np.spacing(np.float32(np.abs(middle).max()))) > finest
    if extent == 0 or away <= (1 if coarse else LARGE) * extent:
        return np.zeros(3)
    return np.round(middle, 1 - round(np.log10(extent)))


def moved_cameras(cameras: Sequence[Camera], shift: np.ndarray) -> list[Camera]:
    """Cameras whose positions are shifted by a (3,) float64 vector, world; the very same for a zero one."""
    if not np.any(shift):
        return list(cameras)
    moved = []
    for camera in cameras:
        matrix = camera.world_to_camera.copy()
        matrix[:3, 3] = -matrix[:3, :3] @ (camera.position + shift)
        moved.append(replace(camera, world_to_camera=matrix))
    return moved


def said(offset: np.ndarray) -> str:
    """An offset as the log shows it: "[4201000.0, 172000.0, 4780000.0]"."""
    return str(np.asarray(offset, np.float64).tolist())
