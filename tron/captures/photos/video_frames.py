"""Frames of a video as photos: the sharpest of each interval, kept as files."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tron.io.images import encode_jpeg
from tron.io.video import Frame
from tron.storage import atomic_folder

FRAMES = "frames"
"""Folder of the frames in a workspace."""
WIDTH = 480
"""Columns that frames are reduced to where they are judged."""
_RECORD = "video.json"


def sharpest(
    frames: Iterable[Frame], interval_of: Callable[[int, Frame], int]
) -> Iterator[tuple[int, Frame]]:
    """The sharpest frame of each interval, with its number among all.

    Args:
        frames: of a video, in order.
        interval_of: tells the interval of a frame and its number, which grows with the number.
    """
    best: tuple[int, Frame] | None = None
    most, interval = -1.0, 0
    for number, frame in enumerate(frames):
        now = interval_of(number, frame)
        if now != interval and best is not None:
            yield best
            best, most = None, -1.0
        interval = now
        sharp = sharpness(frame.grey(WIDTH))
        if sharp > most:
            best, most = (number, frame), sharp
    if best is not None:
        yield best


def sharpness(grey: np.ndarray) -> float:
    """Variance of the Laplacian of a picture (H, W): blur takes it away (Pech-Pacheco et al. 2000)."""
    import cv2

    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def holds_frames(folder: Path, wanted: Mapping[str, Any]) -> bool:
    """Whether a folder was written by :func:`keep_frames` with this record."""
    try:
        return json.loads((folder / _RECORD).read_text("utf-8")) == wanted
    except (OSError, ValueError):
        return False


def keep_frames(folder: Path, record: Mapping[str, Any], frames: Iterable[tuple[str, np.ndarray]]) -> None:
    """Write frames as JPEGs, in a folder that appears whole or not at all.

    Args:
        folder: the folder.
        record: what they were made of, for :func:`holds_frames`.
        frames: name without suffix, and (H, W, 3) uint8, of each.
    """
    with atomic_folder(folder) as made:
        for name, frame in frames:
            (made / f"{name}.jpg").write_bytes(encode_jpeg(frame))
        (made / _RECORD).write_text(json.dumps(record), "utf-8")
