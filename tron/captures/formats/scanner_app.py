"""3D Scanner App's "All data" (Laan Labs): photos of a phone with the poses of ARKit.

    frame_00000.json, ...    frame_00000.jpg, ..., of some of the frames    depth_00000.png, ...

A frame's JSON holds cameraPoseARFrame, 16 numbers, row after row: camera to world, OpenGL's camera axes,
metres, y up; and intrinsics, 9 numbers, the pinhole of its photo, row after row. Depth is in millimetres
along the axis, 16 bits. The app documents no layout; this is how programs that read its exports take it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tron.cameras import opengl_to_opencv, rigid_pose
from tron.captures.formats.polycam import UP
from tron.captures.photos.image_folder import photos_in
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.errors import TronError
from tron.io.transforms_json import read_json
from tron.lenses import Lens, opencv_lens

_FRAMES = "frame_*.json"
_POSE, _PINHOLE = "cameraPoseARFrame", "intrinsics"
_START = 65_536


def is_scanner_app(path: Path) -> bool:
    """Whether a folder holds an export."""
    first = min(path.glob(_FRAMES), default=None)
    if first is None:
        return False
    try:
        with first.open("rb") as stream:
            return f'"{_POSE}"'.encode() in stream.read(_START)
    except OSError:
        return False


def read_scanner_app(path: Path, settings: PhotoSettings) -> PosedPhotos:
    """Read an export; its world is ARKit's, y up, in metres. Frames without a photo are passed over.

    Args:
        path: the export's folder.
        settings: ``images``, a folder of the photos to take instead.

    Raises:
        TronError: no such frames, or none with a photo.
    """
    if not is_scanner_app(path):
        raise TronError("no frames of 3D Scanner App", path)
    named = photos_in(path if settings.images is None else path / settings.images)
    photos = [_photo(each, path) for each in named if each.stem.startswith("frame_")]
    if not photos:
        raise TronError("no photo lies beside its frames", path, "export All data, with its images")
    return PosedPhotos(path, photos, up=UP)


def _photo(photo: Path, folder: Path) -> PosedPhoto:
    file = folder / f"{photo.stem}.json"
    if not file.is_file():
        return PosedPhoto(photo.name, photo, None, None, refused=f"no camera {file.name}")
    try:
        frame = read_json(file)
        pose = opengl_to_opencv(rigid_pose(_square(frame, _POSE, 4)))
        matrix = _square(frame, _PINHOLE, 3)
    except TronError as error:
        return PosedPhoto(photo.name, photo, None, None, refused=error.what)

    def lens(width: int, height: int) -> Lens:
        return opencv_lens(width, height, (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]))

    depth = folder / f"{photo.stem.replace('frame_', 'depth_')}.png"
    return PosedPhoto(photo.name, photo, pose, lens, depth=depth if depth.is_file() else None)


def _square(frame: Mapping[str, Any], key: str, side: int) -> np.ndarray:
    """(side, side) float64 of a list of numbers, row after row."""
    try:
        return np.array(frame.get(key), np.float64).reshape(side, side)
    except (TypeError, ValueError, OverflowError) as error:
        shown = json.dumps(frame.get(key), default=str)[:40]
        raise TronError(f"{key} is {shown}, not {side * side} numbers") from error
