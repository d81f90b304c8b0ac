"""Whether COLMAP's binary files hold what their counts announce.

pycolmap believes the counts: of a file that was cut short or is not COLMAP's it may read on for hours. The
layout is that of COLMAP's ``reconstruction_io_binary.cc``; all numbers are little endian.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from tron.errors import TronError

_CAMERA_BYTES = 24 + 3 * 8  # id, model, width, height and at least three parameters
_POSE_BYTES = 7 * 8


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
