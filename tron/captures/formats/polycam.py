"""Polycam's raw export: photos of a phone with the poses of ARKit.

    keyframes/images/ID.jpg              keyframes/cameras/ID.json
    keyframes/corrected_images/ID.jpg    keyframes/corrected_cameras/ID.json    poses refined over the capture

A camera holds fx, fy, cx, cy, width, height in pixels and t_RC, rows R 0 to 2 and columns C 0 to 3 of its
camera-to-world matrix: OpenGL's camera axes, metres, y up. Facts of Polycam's polyform
(https://github.com/PolyCam/polyform) and of nerfstudio's ns-process-data.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tron.cameras import opengl_to_opencv, rigid_pose
from tron.captures.photos.image_folder import photos_in
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.errors import TronError, located
from tron.io.transforms_json import number, read_json
from tron.lenses import Lens, opencv_lens

UP = np.array([0.0, 1.0, 0.0])
"""ARKit's."""


def camera_folder(path: Path) -> tuple[Path, Path] | None:
    """Folders of the photos and of their cameras, corrected ones if they are there; None where none are."""
    for frames in (path, path / "keyframes"):
        for corrected in ("corrected_", ""):
            photos, cameras = frames / f"{corrected}images", frames / f"{corrected}cameras"
            if photos.is_dir() and cameras.is_dir() and any(cameras.glob("*.json")):
                return photos, cameras
    return None


def read_polycam(path: Path, settings: PhotoSettings) -> PosedPhotos:
    """Read an export; its world is ARKit's, y up, in metres.

    Args:
        path: the export's folder, or the ``keyframes`` in it.
        settings: ``images``, a folder of the photos to take instead.

    Raises:
        TronError: no such folders, or cameras that are not Polycam's.
    """
    found = camera_folder(path)
    if found is None:
        raise TronError("no keyframes/images with keyframes/cameras", path)
    photos, cameras = found
    named = photos_in(photos if settings.images is None else path / settings.images)
    return PosedPhotos(path, [_photo(each, cameras / f"{each.stem}.json") for each in named], up=UP)


def _photo(photo: Path, file: Path) -> PosedPhoto:
    if not file.is_file():
        return PosedPhoto(photo.name, photo, None, None, refused=f"no camera {file.name}")
    camera = read_json(file)
    with located(file):
        rows = [[number(camera, f"t_{row}{column}", np.nan) for column in range(4)] for row in range(3)]
        lens = _lens(camera)
    try:
        pose = opengl_to_opencv(rigid_pose(rows))
    except TronError as error:
        return PosedPhoto(photo.name, photo, None, lens, refused=error.what)
    return PosedPhoto(photo.name, photo, pose, lens)


def _lens(camera: Mapping[str, Any]) -> Lens:
    missing = [key for key in ("fx", "fy", "cx", "cy", "width", "height") if key not in camera]
    if missing:
        raise TronError(f"the camera has no {', '.join(missing)}", mend="is it Polycam's raw export?")
    w, h, fx, fy, cx, cy = (number(camera, key, 0.0) for key in ("width", "height", "fx", "fy", "cx", "cy"))
    return opencv_lens(w, h, (fx, fy), (cx, cy))
