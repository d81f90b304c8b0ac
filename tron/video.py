"""Videos by PyAV: H.264 in an MP4 that every browser plays."""

from __future__ import annotations

import os
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace

from tron.errors import TronError
from tron.storage import atomic_path

_CODECS = ("libx264", "libopenh264", "mpeg4")  # the first that this build of PyAV can encode
_CRF = "18"  # visually lossless


class VideoWriter:
    """Write display frames to an MP4 that appears under its name only when the ``with`` block succeeds.

    Sizes are made even by repeating the last row or column, as the 4:2:0 pixel format demands.

    Args:
        path: the .mp4 file.
        fps: frames a second.
        size: (width, height) in pixels.

    Raises:
        TronError: a frame of another shape, no frame at all, or the file cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float, size: tuple[int, int]):
        if not (fps > 0 and min(size) > 0):
            raise TronError(f"video needs a positive rate and size, not {fps} fps and {size}", path)
        self._path, self._fps, self._size = Path(path), Fraction(fps).limit_denominator(1001), size
        self._exits = ExitStack()
        self._frames = 0

    def __enter__(self) -> VideoWriter:
        with ExitStack() as exits:
            temporary = exits.enter_context(atomic_path(self._path))
            self._container = exits.enter_context(av.open(str(temporary), "w", format="mp4"))
            stream = self._container.add_stream(_codec(), rate=self._fps)
            assert isinstance(stream, av.VideoStream)
            stream.width, stream.height = (side + side % 2 for side in self._size)
            stream.pix_fmt = "yuv420p"
            context = stream.codec_context
            # BT.709 is declared and converted to, or players would guess by size and shift the colours.
            context.color_primaries = context.color_trc = context.colorspace = Colorspace.ITU709.value
            context.color_range = ColorRange.MPEG.value
            context.thread_count = 1  # the same bytes on every machine
            if context.name == "libx264":
                stream.options = {"crf": _CRF, "preset": "medium"}
            self._stream = stream
            self._exits = exits.pop_all()
        return self

    def write(self, frame: np.ndarray) -> None:
        """Append a frame (H, W, 3): display values in [0, 1] as floats (clipped), or uint8."""
        width, height = self._size
        if frame.shape != (height, width, 3):
            raise TronError(f"frame of shape {frame.shape} in a video of {width} x {height}", self._path)
        if frame.dtype != np.uint8:
            frame = np.round(np.clip(np.nan_to_num(frame), 0, 1) * 255).astype(np.uint8)
        frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
        picture = picture.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
        self._container.mux(self._stream.encode(picture))
        self._frames += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._exits:
            if error is not None:
                raise error  # once more, where it also discards the temporary file
            if self._frames == 0:
                raise TronError("video has no frames", self._path)
            self._container.mux(self._stream.encode())


def _codec() -> str:
    """The best encoder in this build of PyAV."""
    return next(name for name in _CODECS if name in av.codecs_available)
