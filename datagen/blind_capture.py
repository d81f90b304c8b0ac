"""Captures as a camera and structure from motion give them: photos, poses, sparse points, perhaps masks.

    transforms.json     nerfstudio's: intrinsics, OpenGL camera-to-world matrices
    images/NAME.jpg     8 bits (or .png)
    masks/NAME.png      8 bits, what is subject; where they are asked for
    sparse.ply          points and their colours, if some are known

No object "tron" (``tron.captures.folder``), so that ``load_capture`` reads the folder as anybody's photos:
without maps, of an exposure and a tone curve that nothing names.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tron.cameras import Camera, opencv_to_opengl
from tron.captures import Capture, LoadSettings, load_capture
from tron.captures.folder import TRANSFORMS_NAME
from tron.captures.points import encode_points
from tron.errors import TronError
from tron.storage import atomic_folder

IMAGES = "images"
MASKS = "masks"
POINTS_NAME = "sparse.ply"


def write_blind_capture(
    path: Path,
    cameras: Mapping[str, Camera],
    photos: Mapping[str, bytes],
    suffix: str,
    points: tuple[np.ndarray, np.ndarray] | None = None,
    masks: Mapping[str, bytes] | None = None,
) -> None:
    """Write the folder; it appears whole or not at all, and replaces the one that is there.

    Args:
        path: the folder.
        cameras: name of a photo -> where it is said to have been taken from.
        photos: name -> file.
        suffix: of the files, such as ".jpg".
        points: positions (N, 3), world, and display colours (N, 3).
        masks: name -> PNG file, if there are any.

    Raises:
        TronError: something else lies at ``path``, or the disk says no.
    """
    if path.exists() and not (path / TRANSFORMS_NAME).is_file():
        raise TronError("folder holds something else than a capture", path, "choose another output_dir")
    with atomic_folder(path) as folder:
        (folder / IMAGES).mkdir()
        for name, data in photos.items():
            (folder / IMAGES / f"{name}{suffix}").write_bytes(data)
        if masks:
            (folder / MASKS).mkdir()
            for name, data in masks.items():
                (folder / MASKS / f"{name}.png").write_bytes(data)
        if points is not None:
            (folder / POINTS_NAME).write_bytes(encode_points(*points))
        text = json.dumps(_transforms(cameras, suffix, points is not None), indent=1) + "\n"
        (folder / TRANSFORMS_NAME).write_bytes(text.encode())


def read_blind_capture(path: Path) -> Capture:
    """The capture as any reader of photos sees it, at its own size.

    Raises:
        TronError: a photo that poses name is missing or damaged, or the folder is no capture.
    """
    capture = load_capture(path, LoadSettings(format="transforms"))
    for name, why in capture.skipped.items():
        raise TronError(why, f"{path}, photo {name}")
    return capture


def _transforms(cameras: Mapping[str, Camera], suffix: str, points: bool) -> dict[str, Any]:
    intrinsics = [_intrinsics(camera) for camera in cameras.values()]
    shared = intrinsics[0] if all(each == intrinsics[0] for each in intrinsics) else {}
    frames = [
        {
            "file_path": f"{IMAGES}/{name}{suffix}",
            **({} if shared else own),
            "transform_matrix": opencv_to_opengl(camera.camera_to_world).tolist(),
        }
        for (name, camera), own in zip(cameras.items(), intrinsics)
    ]
    named = {"ply_file_path": POINTS_NAME} if points else {}
    return {"camera_model": "PINHOLE", **shared, **named, "frames": frames}


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {
        "fl_x": float(camera.fx),
        "fl_y": float(camera.fy),
        "cx": float(camera.cx),
        "cy": float(camera.cy),
        "w": camera.width,
        "h": camera.height,
    }
