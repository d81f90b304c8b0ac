"""RealityCapture's and RealityScan's CSV "Internal/External camera parameters", beside the photos.

    #name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2

One row a photo; a line ``#cameras N`` may come first. Angles are degrees: the camera's axes are OpenGL's,
and camera to world is Rz(-heading) Rx(pitch) Ry(roll), so that all zero looks down with its upper edge to the
north. f is the focal length on film 36 mm wide, which is the photo's longer side; px and py are the principal
point from the photo's middle in longer sides; k and t are Brown's distortion, OpenCV's k1 k2 k3 p1 p2, and k4
is that of r^8. Orientation, f, k and t as nerfstudio's ns-process-data and Brush read them, px and py as
RealityCapture's XMP and Brush have them (nerfstudio calls its own reading a guess). Optional columns may be
absent. Rows without f, as flight logs have them, are no cameras.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from itertools import zip_longest
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tron.cameras import opengl_to_opencv
from tron.captures.photos.image_folder import ImageFolder
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.errors import TronError
from tron.lenses import Lens, opencv_lens

_LARGEST = 100_000_000
_START = 4096
_POSE = ("x", "y", "alt", "heading", "pitch", "roll")
_NEEDED = {"name", *_POSE, "f"}
_DISTORTION = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_FILM = 36.0


def registration_file(path: Path) -> Path | None:
    """The CSV of cameras that a path is, or the first that a folder holds; None where there is none."""
    if path.is_dir():
        return next(filter(None, map(registration_file, sorted(path.glob("*.csv")))), None)
    if path.suffix.lower() != ".csv":
        return None
    try:
        with path.open("rb") as stream:
            lines = stream.read(_START).decode("utf-8-sig", "replace").splitlines()[:2]
    except OSError:
        return None
    return path if any(set(_titles(line)) >= _NEEDED for line in lines) else None


def read_realitycapture(path: Path, settings: PhotoSettings) -> PosedPhotos:
    """Read the cameras of a registration; the world is that of the export.

    Args:
        path: the CSV, or a folder that holds it; photos are sought there and one folder down.
        settings: ``images``, where they are instead.

    Raises:
        TronError: no such CSV, or one without a camera.
    """
    file = registration_file(path)
    if file is None:
        raise TronError(
            "no CSV of RealityCapture's cameras",
            path,
            "export the registration as Internal/External camera parameters",
        )
    rows = _rows(file)
    images = ImageFolder(file.parent, settings.images)
    folders = ["", *(f"{each.name}/" for each in sorted(file.parent.iterdir()) if each.is_dir())]
    photos = []
    for row in rows:
        name = row["name"]
        found = (images.find(folder + name, file) for folder in folders)
        photos.append(_photo(row, next((each for each in found if each is not None), None)))
    return PosedPhotos(path, photos)


def _titles(line: str) -> list[str]:
    return [each.strip().lstrip("#").strip().lower() for each in line.split(",")]


def _rows(file: Path) -> list[dict[str, str]]:
    """Rows by their titles; what a row that was cut short lacks is empty."""
    try:
        if file.stat().st_size > _LARGEST:
            raise TronError("CSV is too large to be one of cameras", file)
        lines = file.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise TronError(f"cannot read: {error}", file) from error
    start = next(index for index, line in enumerate(lines) if set(_titles(line)) >= _NEEDED)
    titles = _titles(lines[start])
    try:
        rows = [
            {title: value.strip() for title, value in zip_longest(titles, row[: len(titles)], fillvalue="")}
            for row in csv.reader(lines[start + 1 :])
        ]
    except csv.Error as error:
        raise TronError(f"not a readable CSV: {error}", file) from error
    rows = [row for row in rows if row.get("name")]
    if not rows:
        raise TronError("no camera of it is registered", file, "align the photos and export them again")
    return rows


def _photo(row: Mapping[str, str], image: Path | None) -> PosedPhoto:
    name = row["name"]
    try:
        pose = [_number(row, key) for key in _POSE]
        calibration = {key: _number(row, key, 0.0) for key in _DISTORTION} | {"f": _number(row, "f")}
        if calibration["k4"]:
            raise TronError("calibrated with k4, which is not supported: export Brown3's distortion")
    except TronError as error:
        return PosedPhoto(name, image, None, None, refused=error.what)
    x, y, z, heading, pitch, roll = pose
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix()
    matrix[:3, 3] = x, y, z
    return PosedPhoto(name, image, opengl_to_opencv(matrix), _lens_maker(calibration))


def _number(row: Mapping[str, str], key: str, default: float | None = None) -> float:
    """A finite number of a row; the default where the file has no such column."""
    text = row.get(key)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise TronError(f"{key} is {text!r}, not a number" if text else f"its row ends before {key}")
    return value


def _lens_maker(calibration: Mapping[str, float]) -> Callable[[int, int], Lens]:
    def lens(width: int, height: int) -> Lens:
        side, of = max(width, height), calibration
        focal = of["f"] / _FILM * side
        center = (width / 2 + of["px"] * side, height / 2 + of["py"] * side)
        return opencv_lens(
            width, height, (focal, focal), center,
            radial=(of["k1"], of["k2"], of["k3"]), tangential=(of["t1"], of["t2"]),
        )  # fmt: skip

    return lens
