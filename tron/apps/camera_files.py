"""Camera paths from files: TRON's own lists of cameras, and camera paths saved by nerfstudio's viewer."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from tron.cameras import Camera, opengl_to_opencv
from tron.errors import TronError


def read_cameras(path: Path, width: int, height: int) -> list[Camera]:
    """Cameras of a JSON file, resized.

    The file is a list of cameras (Camera.to_dict), or an object with such a list as "cameras", as
    relight.json and the metadata of shards have it; or nerfstudio's camera_path.json, whose world is that of
    the scene that nerfstudio exports (`ns-export gaussian-splat`).

    Raises TronError if the file is missing, is no such JSON, holds no camera, or has another aspect ratio.
    """
    cameras = cameras_of(path)
    for camera in cameras:
        if abs(camera.width * height - camera.height * width) > max(width, height):
            scale = max(width, height) / max(camera.width, camera.height)
            fit = [2 * round(scale * side / 2) for side in (camera.width, camera.height)]
            raise TronError(
                f"cameras are {camera.width} x {camera.height}, frames {width} x {height}",
                path,
                f"choose the same aspect ratio, such as width={fit[0]} height={fit[1]}",
            )
    return [camera.resized(width, height) for camera in cameras]


def cameras_of(path: Path) -> list[Camera]:
    """Cameras of a JSON file (see :func:`read_cameras`) at their own size; TronError likewise."""
    try:
        content = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    except ValueError as error:
        raise TronError(f"not JSON: {error}", path) from error
    saved_by_viewer = isinstance(content, dict) and "camera_path" in content
    key = "camera_path" if saved_by_viewer else "cameras"
    entries = content.get(key) if isinstance(content, dict) else content
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        mend = 'give a list, {"cameras": [...]} as in relight.json, or nerfstudio\'s camera_path.json'
        raise TronError("no cameras found", path, mend)
    try:
        return _nerfstudio(content) if saved_by_viewer else [Camera.from_dict(entry) for entry in entries]
    except TronError as error:
        raise TronError(error.what, path, error.mend) from error


def _nerfstudio(content: dict[str, Any]) -> list[Camera]:
    """Cameras of nerfstudio's camera_path.json.

    Each has 16 numbers camera-to-world, row-major, in OpenGL's axes, and the vertical field of view, degrees.
    """
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise TronError(f"nerfstudio's camera path is {kind}", mend="save a perspective one")
    try:
        width, height = int(content["render_width"]), int(content["render_height"])
        return [_camera(entry, width, height) for entry in content["camera_path"]]
    except KeyError as error:
        raise TronError(f"nerfstudio's camera path lacks {error.args[0]!r}") from error
    except (TypeError, ValueError, ZeroDivisionError) as error:
        raise TronError(f"nerfstudio's camera path has an unreadable field: {error}") from error


def _camera(entry: dict[str, Any], width: int, height: int) -> Camera:
    to_world = opengl_to_opencv(np.asarray(entry["camera_to_world"], np.float64).reshape(4, 4))
    focal = 0.5 * height / math.tan(0.5 * math.radians(float(entry["fov"])))
    return Camera(focal, focal, width / 2, height / 2, width, height, np.linalg.inv(to_world))
