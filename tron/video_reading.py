"""Videos read by PyAV: frames upright, in order, with the time that each is shown at."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError

from tron.errors import TronError


class Frame(NamedTuple):
    """Decoded frame.

    Attributes:
        seconds: after the first frame.
        picture: PyAV's frame, as it is stored.
        turned: quarter turns, counter-clockwise, that make it upright.
    """

    seconds: float
    picture: av.VideoFrame
    turned: int

    def rgb(self) -> np.ndarray:
        """(H, W, 3) uint8 display values, upright."""
        return np.ascontiguousarray(np.rot90(self.picture.to_ndarray(format="rgb24"), self.turned))

    def grey(self, width: int) -> np.ndarray:
        """(h, w) uint8, as stored, reduced to at most so many columns."""
        width = min(width, self.picture.width)
        height = max(2, round(self.picture.height * width / self.picture.width))
        return self.picture.reformat(width=width, height=height, format="gray").to_ndarray()


def duration_of(path: Path) -> float:
    """Seconds that a video lasts, as its header says; 0 where it does not.

    Raises:
        TronError: no such file, or no video in it.
    """
    with _opened(path) as container:
        stream = _stream(container, path)
        if stream.duration and stream.time_base:
            return float(stream.duration * stream.time_base)
        return float(container.duration or 0) / av.time_base


def frames_of(path: Path) -> Iterator[Frame]:
    """All frames of a video, one after another.

    Raises:
        TronError: no such file, no video in it, or a part that cannot be decoded.
    """
    with _opened(path) as container:
        stream = _stream(container, path)
        stream.thread_type = "AUTO"
        first = None
        try:
            for picture in container.decode(stream):
                time = float(picture.time or 0.0)
                first = time if first is None else first
                yield Frame(time - first, picture, round((picture.rotation or 0) / 90) % 4)
        except FFmpegError as error:
            raise TronError(f"video is damaged: {error.strerror}", path) from error


def _opened(path: Path) -> InputContainer:
    try:
        return av.open(str(path), "r")
    except (FFmpegError, OSError) as error:
        raise TronError(f"not a readable video: {error.strerror}", path) from error


def _stream(container: InputContainer, path: Path) -> av.VideoStream:
    if not container.streams.video:
        raise TronError("file holds no video", path)
    return container.streams.video[0]
