"""COLMAP's sparse models, binary or text, through pycolmap: poses, lenses and points."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tron.errors import TronError
from tron.lenses import Lens, load_pycolmap

if TYPE_CHECKING:
    import pycolmap

_MAX_ERROR = 2.0
_MIN_TRACK = 3
_CAMERA_BYTES = 24 + 2 * 8  # id, model, width, height and at least two parameters
_POSE_BYTES = 7 * 8
_NAME_FIELD = 9  # of a line of images.txt: id, quaternion, translation, camera id, name
RENAME = "rename the photos before COLMAP poses them"


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a sparse model; TronError if pycolmap cannot or if it holds no posed image."""
    pycolmap = load_pycolmap()
    require_whole(folder)
    try:
        model = pycolmap.Reconstruction(folder)
    except Exception as error:  # damaged files raise ValueError, IndexError, MemoryError, RuntimeError
        raise TronError(f"not a readable COLMAP model: {error}", folder) from error
    if not any(image.has_pose for image in model.images.values()):
        raise TronError("COLMAP model holds no posed image", folder)
    if is_text(folder):
        for number, name in names_in_text(folder).items():
            model.images[number].name = name
    try:
        _ = [image.name for image in model.images.values()]
    except UnicodeDecodeError as error:
        raise TronError("COLMAP model's image names are not UTF-8", folder, RENAME) from error
    return model


def posed_by(model: pycolmap.Reconstruction) -> list[tuple[str, np.ndarray, Lens | tuple[int, int]]]:
    """Name, (4, 4) OpenCV camera-to-world and lens of every posed image, in the order of names.

    In place of the lens of photos of 360 degrees are their width and height. A lens that pycolmap knows and
    that has no pinhole view is refused when a photo of it is used.
    """
    posed = []
    for image in sorted(model.images.values(), key=lambda each: each.name):
        if not image.has_pose:
            continue
        camera_to_world = np.eye(4)
        camera_to_world[:3] = image.cam_from_world().inverse().matrix()
        camera = model.cameras[image.camera_id]
        size = camera.width, camera.height
        around = camera.model.name == "EQUIRECTANGULAR"
        lens = size if around else Lens(camera.model.name, *size, tuple(camera.params))
        posed.append((image.name, camera_to_world, lens))
    return posed


def points_of(model: pycolmap.Reconstruction) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Points (N, 3) and display colours (N, 3) that several photos agree on; None if there are none.

    Kept are points that at least three photos saw and that project within two pixels of where they were seen
    on average; if that leaves less than a tenth, all finite ones are.
    """
    points = list(model.points3D.values())
    if not points:
        return None, None
    xyz = np.array([point.xyz for point in points])
    colors = np.array([point.color for point in points], np.float64) / 255
    errors = np.array([point.error for point in points])
    tracks = np.array([point.track.length() for point in points])
    finite = np.isfinite(xyz).all(1)
    good = finite & (tracks >= _MIN_TRACK) & ~(errors > _MAX_ERROR)
    kept = good if good.sum() >= 0.1 * len(good) else finite
    return (xyz[kept], colors[kept]) if kept.any() else (None, None)


# pycolmap believes the counts: of a file that was cut short or is not COLMAP's it may read on for hours. The
# layout is that of COLMAP's ``reconstruction_io_binary.cc``; all numbers are little endian.


def require_whole(folder: Path) -> None:
    """Walk through the binary files of a sparse model; those that are absent or text are not looked at.

    Raises:
        TronError: a file ends before its last record.
    """
    for name, walk in _WALKS.items():
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
        try:
            data = path.read_bytes()
            (count,) = struct.unpack_from("<Q", data)
            if count > len(data):  # every record has at least a byte; do not count to 2**64
                raise ValueError(count)
            end = walk(data, count)
        except OSError as error:
            raise TronError(f"cannot read: {error.strerror or error}", path) from error
        except (struct.error, ValueError) as error:
            raise TronError("COLMAP file is cut short or damaged", path) from error
        if end > len(data):
            raise TronError("COLMAP file is cut short or damaged", path)


def _cameras(_data: bytes, count: int) -> int:
    return 8 + count * _CAMERA_BYTES


def _images(data: bytes, count: int) -> int:
    """id, pose, camera id; the name, ended by zero; a count of 2D points and x, y, point id of each."""
    at = 8
    for _ in range(count):
        at = data.index(b"\0", at + 8 + _POSE_BYTES) + 1
        (points,) = struct.unpack_from("<Q", data, at)
        at += 8 + 24 * points
    return at


def _points(data: bytes, count: int) -> int:
    """id, position, colour, error; a count of track elements and image id, index of each."""
    at = 8
    for _ in range(count):
        (track,) = struct.unpack_from("<Q", data, at + 43)
        at += 51 + 8 * track
    return at


def _rigs(data: bytes, count: int) -> int:
    """id, count of sensors; the first one's type and id; of the others also a flag and, if set, a pose."""
    at = 8
    for _ in range(count):
        (sensors,) = struct.unpack_from("<I", data, at + 4)
        at += 8 + (8 if sensors else 0)
        for _ in range(1, sensors):
            at += 9 + (_POSE_BYTES if data[at + 8 : at + 9] != b"\0" else 0)
            if at > len(data):
                return at
    return at


def _frames(data: bytes, count: int) -> int:
    """id, rig id, pose; a count of data and sensor type, sensor id, data id of each."""
    at = 8
    for _ in range(count):
        (data_ids,) = struct.unpack_from("<I", data, at + 8 + _POSE_BYTES)
        at += 12 + _POSE_BYTES + 16 * data_ids
    return at


_WALKS: dict[str, Callable[[bytes, int], int]] = {
    "cameras": _cameras,
    "images": _images,
    "points3D": _points,
    "rigs": _rigs,
    "frames": _frames,
}


def names_in_text(model: Path) -> dict[int, str]:
    """Names by image id in ``images.txt``, spaces and all: pycolmap ends them at the first.

    Raises:
        TronError: the file cannot be read, or its lines are not two an image.
    """
    path = model / "images.txt"
    names: dict[int, str] = {}
    try:
        with path.open(encoding="utf-8") as lines:
            for line in lines:
                if not line.strip() or line.lstrip().startswith("#"):
                    continue
                fields = line.strip().split(maxsplit=_NAME_FIELD)
                names[int(fields[0])] = fields[_NAME_FIELD]
                int((next(lines, "").split()[-1:] or ["0"])[0])  # x, y and point id of each; often none
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    except UnicodeDecodeError as error:
        raise TronError("COLMAP model's image names are not UTF-8", path, RENAME) from error
    except (ValueError, IndexError) as error:
        mend = "each image has two lines, the second of its points or empty"
        raise TronError("not a readable COLMAP model", path, mend) from error
    return names


def is_text(model: Path) -> bool:
    """Whether pycolmap reads a model's text files: it does where one of the binary ones is missing."""
    return not all((model / f"{name}.bin").is_file() for name in ("cameras", "images", "points3D"))
