"""Stray Scanner's recordings: the video of a phone with the poses of ARKit.

    rgb.mp4    odometry.csv    camera_matrix.csv    depth/000000.png, 000001.png, ...

A row of odometry.csv is a frame: timestamp, frame, x, y, z, qx, qy, qz, qw, camera to world in OpenCV's
camera axes, metres, y up; newer ones add the frame's fx, fy, cx, cy. The oldest have x to qw alone, in the
order of frames. camera_matrix.csv is the pinhole, row after row; depth is in millimetres along the axis, 16
bits, in older recordings .npy. Facts of the format's page and OdometryEncoder.swift in
https://github.com/strayrobots/scanner.
"""

from __future__ import annotations

import csv
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from tron.captures.formats.polycam import UP
from tron.captures.photos.image_folder import photos_in
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.photos.video_frames import FRAMES, holds_frames, keep_frames, sharpest
from tron.errors import TronError
from tron.io.video import frames_of
from tron.lenses import Lens, opencv_lens
from tron.storage import locked, sha256

log = logging.getLogger(__name__)

_VIDEO, _ODOMETRY, _MATRIX = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
_VERSION = 1
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_PINHOLE = ("fx", "fy", "cx", "cy")
_UNIT = 0.01
_LAST = 10_000_000
"""Frames of no recording: two days of them."""


class FilmSettings(Protocol):
    """How many frames are taken of a recording's video, and the folder that keeps them."""

    @property
    def frames(self) -> int: ...

    @property
    def workspace(self) -> Path | None: ...


def is_stray_scanner(path: Path) -> bool:
    """Whether a folder holds a recording."""
    return (path / _VIDEO).is_file() and (path / _ODOMETRY).is_file()


def read_stray_scanner(path: Path, settings: FilmSettings) -> PosedPhotos:
    """Take the sharpest frames of a recording; its world is ARKit's, y up, in metres.

    Frames are kept in the workspace, by default ``rgb_frames`` in the recording's folder. Poses belong to the
    frames as they are stored, which are not turned upright.

    Args:
        path: the recording's folder.
        settings: ``frames``, how many, and ``workspace``.

    Raises:
        TronError: no such files, tables that are not Stray Scanner's, or a video that cannot be read.
    """
    rows = _rows(path / _ODOMETRY)
    matrix = _matrix(path / _MATRIX) if (path / _MATRIX).is_file() else None
    if matrix is None and not set(_PINHOLE) <= next(iter(rows.values())).keys():
        raise TronError(f"recording has no {_MATRIX}", path, "copy the whole folder from the phone")
    workspace = settings.workspace or path / f"{Path(_VIDEO).stem}_{FRAMES}"
    with locked(workspace):
        folder = _kept_frames(path / _VIDEO, rows, settings.frames, workspace)
    photos = []
    for photo in photos_in(folder):
        depths = (path / "depth" / f"{photo.stem}{suffix}" for suffix in (".png", ".npy"))
        depth = next((each for each in depths if each.is_file()), None)
        photos.append(_photo(photo, rows[int(photo.stem)], matrix, depth))
    return PosedPhotos(path, photos, up=UP)


def _rows(file: Path) -> dict[int, dict[str, float]]:
    """Numbers of each row by the number of its frame; NaN where there are none."""
    try:
        with file.open(encoding="utf-8", newline="") as stream:
            lines = [row for row in csv.reader(stream, skipinitialspace=True) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise TronError(f"cannot read: {error}", file) from error
    titles = [each.strip().lower() for each in lines[0]] if lines else []
    if set(_POSE) <= set(titles):
        lines = lines[1:]
    elif titles and len(titles) == len(_POSE):
        titles = list(_POSE)
    else:
        raise TronError(f"rows are not {', '.join(_POSE)}", file, "is it Stray Scanner's recording?")
    rows = {}
    for index, line in enumerate(lines):
        row = {title: _number(text) for title, text in zip(titles, line)}
        frame = row.get("frame", float(index))
        if np.isfinite(frame) and not 0 <= frame < _LAST:
            mend = "is it Stray Scanner's recording?"
            raise TronError(f"row {index + 1} is of frame {frame:g}", file, mend)
        rows[int(frame) if np.isfinite(frame) else index] = row
    if not rows:
        raise TronError("holds no frame", file)
    return rows


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def _matrix(file: Path) -> dict[str, float]:
    """fx, fy, cx and cy of the video's frames."""
    try:
        values = np.loadtxt(file, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise TronError(f"not a matrix: {error}", file) from error
    if values.shape != (3, 3) or not np.isfinite(values).all() or min(values[0, 0], values[1, 1]) <= 0:
        raise TronError("not the 3 x 3 matrix of a camera", file, "is it Stray Scanner's recording?")
    numbers = (values[0, 0], values[1, 1], values[0, 2], values[1, 2])
    return dict(zip(_PINHOLE, map(float, numbers)))


def _kept_frames(video: Path, rows: Mapping[int, object], count: int, workspace: Path) -> Path:
    """Folder of the sharpest frames that have a pose, named by their numbers."""
    folder, last = workspace / FRAMES, max(rows)
    wanted = {"version": _VERSION, "video": sha256(video), "frames": count, "poses": sorted(rows)}
    if holds_frames(folder, wanted):
        return folder
    log.info("%s: looking for the sharpest frames of %d intervals", video, count)
    chosen = sharpest(frames_of(video), lambda number, _: number * count // (last + 1))
    as_stored = ((number, frame._replace(turned=0)) for number, frame in chosen if number in rows)
    keep_frames(folder, wanted, ((f"{number:06d}", frame.rgb()) for number, frame in as_stored))
    return folder


def _photo(
    photo: Path, row: Mapping[str, float], matrix: Mapping[str, float] | None, depth: Path | None
) -> PosedPhoto:
    pose = np.array([row.get(key, np.nan) for key in _POSE])
    own = {key: row.get(key, np.nan) for key in _PINHOLE}
    pinhole = own if matrix is None or np.isfinite(list(own.values())).all() else matrix
    if not np.isfinite(pose).all():
        return PosedPhoto(photo.name, photo, None, None, refused="pose is cut short or holds NaN or infinity")
    if abs(np.linalg.norm(pose[3:]) - 1) > _UNIT:
        return PosedPhoto(photo.name, photo, None, None, refused="pose holds no unit quaternion")
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = Rotation.from_quat(pose[3:]).as_matrix()
    camera_to_world[:3, 3] = pose[:3]

    def lens(width: int, height: int) -> Lens:
        fx, fy, cx, cy = (pinhole[key] for key in _PINHOLE)
        return opencv_lens(width, height, (fx, fy), (cx, cy))

    return PosedPhoto(photo.name, photo, camera_to_world, lens, depth=depth)
