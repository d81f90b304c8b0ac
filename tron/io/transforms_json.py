"""Poses and intrinsics of ``transforms.json``: what its dialects (NeRF, instant-ngp, nerfstudio) share.

Matrices are OpenGL's, camera-to-world. With p the world of COLMAP and q that of the file, nerfstudio wrote
q = scale (A p + t), which is undone. Photos that frames name are sought in
:mod:`tron.captures.formats.transforms`.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tron.cameras import Camera, opengl_to_opencv, rigid_pose
from tron.errors import TronError, located
from tron.io.recognised import refuse_by_sight

log = logging.getLogger(__name__)

_MAX_BYTES = 500_000_000
EQUIRECTANGULAR = "EQUIRECTANGULAR"
"""nerfstudio's ``camera_model`` of photos of 360 degrees."""
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


class Intrinsics(NamedTuple):
    """Pinhole of a frame, pixels.

    Attributes:
        width: of the image that the other numbers belong to.
        height: likewise.
        focal: along x and y.
        center: principal point, x and y.
    """

    width: float
    height: float
    focal: tuple[float, float]
    center: tuple[float, float]


def cameras_of_transforms(file: Path, size: tuple[int, int]) -> list[Camera]:
    """Cameras of all frames, in the file's order, without looking at the photos.

    They stand in the world that a capture of this file has: COLMAP's, where ``applied_transform`` says how
    the file's was made of it. Lenses are taken without their distortion, which a line says.

    Args:
        file: a transforms.json.
        size: (width, height) in pixels of frames that have none.

    Raises:
        TronError: unreadable JSON, no frames, a pose or intrinsics that cannot be used.
    """
    meta = read_json(file)
    transform = to_original(meta, file)
    cameras, distorted = [], 0
    for index, frame in enumerate(frames_of(meta, file)):
        with located(f"{file}, frame {index}"):
            if not isinstance(frame, dict):
                raise TronError("frame is no object")
            pose = rigid_pose(transform @ opengl_to_opencv(rigid_pose(frame.get("transform_matrix"))))
            data = described(meta, frame)
            if data.get("camera_model") == EQUIRECTANGULAR:
                raise TronError("camera of 360 degrees, which is no one view", mend="choose another path")
            width, height, focal, center = intrinsics_of(data, *size)
            distorted += any(number(data, key, 0.0) for key in _DISTORTION)
            camera = Camera(*focal, *center, round(width), round(height), np.linalg.inv(pose))
            cameras.append(camera)
    if distorted:
        log.info("%s: the lenses of %d cameras are taken without their distortion", file, distorted)
    return cameras


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file that holds an object; TronError if it cannot be read or holds something else."""
    return _read(path, dict)


def read_list(path: Path) -> list[Any]:
    """A JSON file that holds a list; TronError if it cannot be read or holds something else."""
    return _read(path, list)


def _read(path: Path, kind: type) -> Any:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise TronError("JSON file is too large", path)
        refuse_by_sight(path, "this should be a JSON of poses")
        content = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    except (ValueError, RecursionError) as error:
        raise TronError(f"not readable as JSON: {error}", path) from error
    if not isinstance(content, kind):
        wanted = "an object" if kind is dict else "a list"
        raise TronError(f"JSON holds a {type(content).__name__}, not {wanted}", path)
    return content


def frames_of(meta: Mapping[str, Any], file: Path) -> list[Any]:
    """The list of frames of a file; TronError where there is none or it is empty."""
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames:
        raise TronError("JSON holds no list of frames", file, "is this a transforms.json?")
    return frames


def described(meta: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """All that is said of a frame, by itself or the file, whose focal lengths give way to any of its own."""
    own = {"fl_x", "camera_angle_x"} & frame.keys()
    focal = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
    shared = {key: value for key, value in meta.items() if key != "frames" and not (own and key in focal)}
    return {**shared, **frame}


def intrinsics_of(data: Mapping[str, Any], width: float, height: float) -> Intrinsics:
    """Pinhole of what is :func:`described`; ``width`` and ``height`` where the data say none.

    Raises:
        TronError: no focal length, or something that is no number.
    """
    w, h = number(data, "w", width), number(data, "h", height)
    fx, fy = _focal(data, "x", w), _focal(data, "y", h)
    either = fx if fx is not None else fy
    if either is None:
        raise TronError("no focal length: fl_x or camera_angle_x is missing")
    focal = (either, fy if fy is not None else either)
    return Intrinsics(w, h, focal, (number(data, "cx", w / 2), number(data, "cy", h / 2)))


def number(data: Mapping[str, Any], key: str, default: float) -> float:
    """A finite number of the data, or the default where there is none; TronError for anything else."""
    value = data.get(key)
    if value is None:
        return float(default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise TronError(f"{key} is {value!r}, not a number")
    return float(value)


def to_original(meta: Mapping[str, Any], file: Path) -> np.ndarray:
    """(4, 4) from the file's world to the one before applied_transform and applied_scale."""
    applied = np.eye(4)
    if meta.get("applied_transform") is not None:
        try:
            matrix = np.array(meta["applied_transform"], dtype=np.float64)
            applied[:3] = matrix[:3]
            if matrix.shape not in ((3, 4), (4, 4)):
                raise ValueError("shape")
        except (TypeError, ValueError) as error:
            raise TronError("applied_transform is not a 3 x 4 matrix", file) from error
    scale = number(meta, "applied_scale", 1.0)
    applied[:3] *= scale
    linear = applied[:3, :3]
    size = np.cbrt(abs(np.linalg.det(linear)))
    if not (
        size > 1e-9 and scale > 0 and np.allclose(linear @ linear.T, size**2 * np.eye(3), atol=1e-3 * size**2)
    ):
        raise TronError("applied_transform is not a rotation with one scale", file)
    if np.linalg.det(linear) < 0:
        raise TronError("applied_transform is mirrored", file)
    return np.linalg.inv(applied)


def _focal(data: Mapping[str, Any], axis: str, side: float) -> float | None:
    if data.get(f"fl_{axis}") is not None:
        return number(data, f"fl_{axis}", 0.0)
    if data.get(f"camera_angle_{axis}") is not None:
        angle = number(data, f"camera_angle_{axis}", 0.0)
        if not 0 < angle < math.pi:
            raise TronError(f"camera_angle_{axis} is {angle:g}, not between 0 and pi")
        return 0.5 * side / math.tan(0.5 * angle)
    return None
