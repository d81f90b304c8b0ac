"""Record3D's export ("EXR + RGB"): frames of a phone's video with the poses of ARKit.

    rgb/0.jpg, 1.jpg, ...    metadata.json (or metadata)

The metadata hold w, h in pixels, K, the 3 x 3 pinhole matrix column after column, or for each frame
perFrameIntrinsicCoeffs, fx fy cx cy; and poses, for each frame qx qy qz qw tx ty tz: camera to world,
OpenGL's camera axes, metres, y up. Facts of https://github.com/marek-simonik/record3d and of ns-process-data.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tron.cameras import opengl_to_opencv
from tron.captures.formats.polycam import UP
from tron.captures.photos.image_folder import photos_in
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.errors import TronError, located
from tron.io.transforms_json import number, read_json
from tron.lenses import Lens, opencv_lens

_NAMES = ("metadata.json", "metadata")


def metadata_file(path: Path) -> Path | None:
    """The metadata of an export; None where a folder is none."""
    return next((path / name for name in _NAMES if (path / "rgb").is_dir() and (path / name).is_file()), None)


def read_record3d(path: Path, settings: PhotoSettings) -> PosedPhotos:
    """Read an export; its world is ARKit's, y up, in metres.

    Args:
        path: the folder of ``rgb`` and ``metadata.json``.
        settings: ``images``, a folder to search instead of ``rgb``.

    Raises:
        TronError: no such files, or metadata that are not Record3D's.
    """
    file = metadata_file(path)
    if file is None:
        raise TronError("no rgb with metadata.json", path)
    meta = read_json(file)
    frames = {each.stem: each for each in photos_in(path / (settings.images or "rgb"))}
    with located(file):
        poses = _table(meta, "poses", 7)
        lenses = _lenses(meta, len(poses))
    photos = []
    for index, (pose, lens) in enumerate(zip(poses, lenses)):
        matrix, refused = np.eye(4), None
        if np.linalg.norm(pose[:4]) > 0:
            matrix[:3, :3] = Rotation.from_quat(pose[:4]).as_matrix()
            matrix[:3, 3] = pose[4:]
        else:
            refused = "pose holds a zero quaternion"
        name = f"{index}.jpg"
        photos.append(
            PosedPhoto(name, frames.get(str(index)), opengl_to_opencv(matrix), lens, refused=refused)
        )
    return PosedPhotos(path, photos, up=UP)


def _table(meta: Mapping[str, Any], key: str, columns: int) -> np.ndarray:
    """(N, columns) float64 of the metadata."""
    try:
        table = np.array(meta.get(key), np.float64)
        whole = table.ndim == 2 and len(table) > 0 and table.shape[1] >= columns and np.isfinite(table).all()
    except (TypeError, ValueError):
        whole = False
    if not whole:
        raise TronError(f"{key} is no list of {columns} numbers a frame", mend="is it Record3D's export?")
    return table[:, :columns]


def _lenses(meta: Mapping[str, Any], count: int) -> list[Lens]:
    size = number(meta, "w", 0.0), number(meta, "h", 0.0)
    if not min(size) > 0:
        raise TronError("there is no w and h", mend="is it Record3D's export?")
    if meta.get("perFrameIntrinsicCoeffs"):
        each = _table(meta, "perFrameIntrinsicCoeffs", 4)
    else:
        matrix = _table({"K": [meta.get("K")]}, "K", 9).reshape(3, 3).T
        each = np.array([[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]]).repeat(count, axis=0)
    if len(each) != count:
        raise TronError(f"perFrameIntrinsicCoeffs are of {len(each)} frames, poses of {count}")
    return [opencv_lens(*size, (fx, fy), (cx, cy)) for fx, fy, cx, cy in each]
