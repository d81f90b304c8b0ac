"""Cameras in JSON: TRON's own lists, 3DGS' cameras.json, nerfstudio's camera_path.json, SuperSplat's project.

They are in the frame of the scene's file. :mod:`tron.io.transforms_json` reads transforms.json.
"""

from __future__ import annotations

import json
import logging
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tron.cameras import Camera, opencv_to_opengl, opengl_to_opencv, rigid_pose
from tron.errors import TronError

log = logging.getLogger(__name__)

_SUPERSPLAT = np.diag([-1.0, -1.0, 1.0, 1.0])
"""From the frame of a PLY to the world that SuperSplat shows it in, y up (its src/file-handler.ts)."""
_LARGEST_DOCUMENT = 64 * 2**20


def of_list(entries: list[dict[str, Any]]) -> list[Camera]:
    """Cameras of a list: TRON's (Camera.to_dict), or those of a 3DGS model."""
    return [_of_graphdeco(each) if "rotation" in each else Camera.from_dict(each) for each in entries]


def _of_graphdeco(entry: dict[str, Any]) -> Camera:
    """Camera of 3DGS' cameras.json: centre, rows of the rotation camera-to-world (OpenCV), focal lengths.

    The principal point is the middle, as 3DGS renders it (`camera_to_JSON` of its utils/camera_utils.py).
    """
    try:
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = entry["rotation"], entry["position"]
        fx, fy = float(entry["fx"]), float(entry["fy"])
        width, height = int(entry["width"]), int(entry["height"])
    except KeyError as error:
        raise TronError(f"camera of a 3DGS model lacks the field {error.args[0]!r}") from error
    except (TypeError, ValueError) as error:
        raise TronError(f"camera of a 3DGS model has an unreadable field: {error}") from error
    return Camera(fx, fy, width / 2, height / 2, width, height, np.linalg.inv(rigid_pose(to_world)))


def cameras_json(_path: Path, cameras: list[Camera], _fps: float) -> str:
    """A cameras.json of 3DGS."""
    say_centred(cameras)
    return _json(
        [
            {
                "id": n, "img_name": f"{n:05d}", "width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy,
                "position": c.position.tolist(), "rotation": c.camera_to_world[:3, :3].tolist(),
            }
            for n, c in enumerate(cameras)
        ]
    )  # fmt: skip


def of_camera_path(content: dict[str, Any], entries: list[dict[str, Any]]) -> list[Camera]:
    """Cameras of nerfstudio's camera_path.json, and its entries.

    Each has 16 numbers camera-to-world, row-major, in OpenGL's axes, and the vertical field of view, degrees.
    """
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise TronError(f"nerfstudio's camera path is {kind}", mend="save a perspective one")
    try:
        width, height = int(content["render_width"]), int(content["render_height"])
        return [_camera(entry, width, height) for entry in entries]
    except KeyError as error:
        raise TronError(f"nerfstudio's camera path lacks {error.args[0]!r}") from error
    except (TypeError, ValueError, ZeroDivisionError) as error:
        raise TronError(f"nerfstudio's camera path has an unreadable field: {error}") from error


def _camera(entry: dict[str, Any], width: int, height: int) -> Camera:
    to_world = opengl_to_opencv(np.asarray(entry["camera_to_world"], np.float64).reshape(4, 4))
    focal = 0.5 * height / math.tan(0.5 * math.radians(float(entry["fov"])))
    return Camera(focal, focal, width / 2, height / 2, width, height, np.linalg.inv(to_world))


def camera_path_json(_path: Path, cameras: list[Camera], fps: float) -> str:
    """A camera_path.json of nerfstudio."""
    say_centred(cameras, square=True)
    first = cameras[0]
    entries = [
        {
            "camera_to_world": opencv_to_opengl(c.camera_to_world).ravel().tolist(),
            "fov": math.degrees(2 * math.atan(c.height / 2 / c.fy)), "aspect": c.width / c.height,
        }
        for c in cameras
    ]  # fmt: skip
    return _json(
        {
            "camera_type": "perspective", "render_width": first.width, "render_height": first.height,
            "fps": fps, "seconds": len(cameras) / fps, "smoothness_value": 0, "is_cycle": False, "crop": None,
            "keyframes": [], "camera_path": entries,
        }
    )  # fmt: skip


def transforms_json(_path: Path, cameras: list[Camera], _fps: float) -> str:
    """A transforms.json of photos that do not exist yet."""
    frames = [
        {
            "file_path": f"images/{n:05d}.png", "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy,
            "w": c.width, "h": c.height, "transform_matrix": opencv_to_opengl(c.camera_to_world).tolist(),
        }
        for n, c in enumerate(cameras)
    ]  # fmt: skip
    return _json({"camera_model": "PINHOLE", "frames": frames})


def supersplat_document(path: Path) -> dict[str, Any]:
    """The JSON inside SuperSplat's project, .ssproj, a ZIP; nothing is unpacked."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open("document.json") as stream:
            text = stream.read(_LARGEST_DOCUMENT + 1)
        if len(text) > _LARGEST_DOCUMENT:
            raise TronError("project's document is too large", path)
        return json.loads(text)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, NotImplementedError) as error:
        raise TronError(f"not a readable project of SuperSplat: {error}", path) from error


def of_supersplat(document: dict[str, Any], size: tuple[int, int]) -> list[Camera]:
    """Key poses of SuperSplat's timeline, in the order of their frames; it goes through them on a spline.

    A pose is where the camera is and what it looks at, y up; the field of view is that of the longer side.
    """
    sets = document.get("poseSets") or []
    poses = sorted((pose for each in sets for pose in each["poses"]), key=lambda pose: pose.get("frame", 0))
    if not poses:
        raise TronError("SuperSplat's project holds no camera poses", mend="add keys to its timeline")
    common = (document.get("camera") or document.get("view") or {}).get("fov", 60.0)
    width, height = size
    cameras = []
    try:
        for pose in poses:
            longer = math.radians(float(pose.get("fov", common)))
            fov = 2 * math.degrees(math.atan(math.tan(longer / 2) * width / max(width, height)))
            camera = Camera.look_at(
                pose["position"], pose["target"], up=(0, 1, 0), fov_deg=fov, width=width, height=height
            )
            matrix = camera.world_to_camera @ _SUPERSPLAT
            cameras.append(Camera(camera.fx, camera.fy, camera.cx, camera.cy, width, height, matrix))
    except (KeyError, TypeError, ValueError) as error:
        raise TronError(f"SuperSplat's pose has an unreadable field: {error}") from error
    return cameras


def say_centred(cameras: Sequence[Camera], square: bool = False) -> None:
    """A line in the log where what a format cannot say is lost."""
    off = max(max(abs(c.cx - c.width / 2) / c.width, abs(c.cy - c.height / 2) / c.height) for c in cameras)
    wide = max(abs(c.fx / c.fy - 1) for c in cameras) if square else 0.0
    if max(off, wide) > 1e-6:
        log.warning(
            "this format has centred lenses%s: the middle is off by up to %.2g of the picture",
            " and square pixels" if square else "", max(off, wide),
        )  # fmt: skip


def _json(content: Any) -> str:
    return json.dumps(content, indent=1) + "\n"
