"""Cameras of COLMAP's models, in the frame of the scene's file."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tron.cameras import Camera
from tron.errors import TronError
from tron.io.recognised import refuse_by_sight

log = logging.getLogger(__name__)

_TWO_FOCAL = (
    *("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE"),
    "RAD_TAN_THIN_PRISM_FISHEYE",
)
"""COLMAP's models whose first four numbers are fx, fy, cx, cy; others have f, cx, cy."""


def read_colmap(path: Path, *_given: Any) -> list[Camera]:
    """Cameras of the COLMAP model that a file is of; lenses without their distortion."""
    refuse_by_sight(path, "cameras are a JSON file")
    from tron.io.colmap import posed_by, read_model

    try:
        posed = posed_by(read_model(path.parent))
    except ModuleNotFoundError as error:
        raise TronError("COLMAP's models need pycolmap", path, "pip install pycolmap") from error
    cameras, distorted = [], 0
    for _, pose, lens in posed:
        if isinstance(lens, tuple):
            raise TronError("camera of 360 degrees, which is no one view", path, "choose another path")
        numbers, two = lens.parameters, lens.model in _TWO_FOCAL
        fx, fy, cx, cy = numbers[:4] if two else (numbers[0], numbers[0], *numbers[1:3])
        distorted += any(numbers[4 if two else 3 :])
        cameras.append(Camera(fx, fy, cx, cy, round(lens.width), round(lens.height), np.linalg.inv(pose)))
    if distorted:
        log.info("%s: the lenses of %d cameras are taken without their distortion", path, distorted)
    return cameras


def images_txt(path: Path, cameras: list[Camera], _fps: float) -> dict[str, str]:
    """An images.txt with a cameras.txt and an empty points3D.txt beside it."""
    lenses, images = [], []
    for n, c in enumerate(cameras, 1):
        lenses.append(f"{n} PINHOLE {c.width} {c.height} {c.fx!r} {c.fy!r} {c.cx!r} {c.cy!r}")
        x, y, z, w = Rotation.from_matrix(c.world_to_camera[:3, :3]).as_quat().tolist()
        shift = " ".join(map(repr, c.world_to_camera[:3, 3].tolist()))
        images.append(f"{n} {w!r} {x!r} {y!r} {z!r} {shift} {n} {n - 1:05d}.png\n")
    return {
        "cameras.txt": "\n".join(lenses) + "\n",
        path.name: "\n".join(images) + "\n",
        "points3D.txt": "# none\n",
    }
