"""Scans made from one photo, as Apple's SHARP makes them: known, and filmed from where it was taken.

They keep the photo's camera at the origin, that looks along +z, x right and y down. What it did not see is
not there: from behind such a scan is the inside of a shell, and cameras around it would film that.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from tron.cameras import Camera
from tron.gaussians.ply import header_elements
from tron.gaussians.scene import GaussianScene

log = logging.getLogger(__name__)

_ELEMENTS = {"extrinsic", "intrinsic", "image_size"}
"""Of the PLYs of SHARP (apple/ml-sharp, save_ply), beside their splats."""
_FEWEST = 500
_AHEAD, _WIDEST = 0.99, 1.2
"""Share of the splats before the camera, and the tangent within which 95 % of them are seen."""
_SIZES, _SHELL = 0.4, 0.05
"""Deviation of the logarithm of sizes over distances; and how far apart the logarithms of distances in one
direction are, in the median of all directions."""
_PER_CELL = 6
_SHARE = 0.98
_BASELINE, _PLACES, _SIDE = 0.04, 8, 512
"""Cameras stand around the photo's, this share of the median distance away from it."""


def one_view(path: Path, scene: GaussianScene, turn: np.ndarray) -> list[Camera] | None:
    """Cameras about where a scan was seen from, the photo's first; None of other scans.

    Args:
        path: the scan's file.
        scene: what it holds, turned by ``turn`` (3, 3).
        turn: from the file's frame to that of the scene and of the cameras.
    """
    if scene.offset.any():
        return None
    places = scene.means.astype(np.float64) @ turn  # in the file's frame
    if not (header_elements(path) >= _ELEMENTS or _one_shell(places, scene.scales().max(1))):
        return None
    ahead = places[places[:, 2] > 0]
    tangents = np.quantile(np.abs(ahead[:, :2]) / ahead[:, 2:], _SHARE, axis=0).clip(0.05, 3)
    distance = float(np.median(ahead[:, 2]))
    width = round(_SIDE * min(1, tangents[0] / tangents[1]))
    view = {
        "up": turn @ (0, -1, 0), "fov_deg": float(2 * np.degrees(np.arctan(tangents[0]))),
        "width": max(width, 16), "height": max(round(width * tangents[1] / tangents[0]), 16),
    }  # fmt: skip
    target = turn @ (0, 0, distance)
    angles = 2 * np.pi * np.arange(_PLACES) / _PLACES
    around = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1) * _BASELINE * distance
    log.warning(
        "%s was made from one view: what that did not see is not there, and light comes in from behind; "
        "it is filmed from there (cameras.json beside it would say otherwise)", path,
    )  # fmt: skip
    return [Camera.look_at(turn @ place, target, **view) for place in (np.zeros(3), *around)]


def _one_shell(places: np.ndarray, sizes: np.ndarray) -> bool:
    """Whether splats lie in one layer about the origin, before +z, of sizes that grow with the distance.

    Args:
        places: (M, 3) in the file's frame.
        sizes: (M,) the larger of their standard deviations.
    """
    if len(places) < _FEWEST or (places[:, 2] > 0).mean() < _AHEAD:
        return False
    ahead = places[:, 2] > 0
    places, sizes = places[ahead], sizes[ahead]
    seen = places[:, :2] / places[:, 2:]
    if np.quantile(np.abs(seen).max(1), 0.95) > _WIDEST:
        return False
    distances = np.log(np.linalg.norm(places, axis=1))
    if np.std(np.log(sizes) - distances) > _SIZES:
        return False
    side = max(int(np.sqrt(len(places) / _PER_CELL)), 4)
    low, high = np.quantile(seen, [0.01, 0.99], axis=0)
    cells = np.clip((seen - low) / (high - low).clip(1e-9) * side, 0, side - 1).astype(int) @ (side, 1)
    order = np.lexsort((distances, cells))
    starts = np.flatnonzero(np.diff(cells[order], prepend=-1))
    ends = np.append(starts[1:], len(order)) - 1
    several = ends > starts
    apart = distances[order[ends[several]]] - distances[order[starts[several]]]
    return bool(several.sum() > 8 and np.median(apart) < _SHELL)
