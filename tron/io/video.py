"""Videos by PyAV: written as H.264 in an MP4 that every browser plays; read upright, in order, in sRGB."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.video.reformatter import ColorRange, Colorspace, Interpolation

from tron.errors import TronError, located
from tron.io.color_spaces import HLG, PQ, PRIMARIES, TRANSFERS, colour_science, srgb_of
from tron.storage import atomic_path

_CODECS = ("libx264", "libopenh264", "mpeg4")  # the first that this build of PyAV can encode
_CRF = "18"  # visually lossless
log = logging.getLogger(__name__)
_UNSAID = (0, 2, 3)  # code points that are reserved or say that they say nothing
_BT2020 = 9
_MATRICES = {
    **{1: Colorspace.ITU709, 5: Colorspace.ITU601, 6: Colorspace.ITU601, _BT2020: Colorspace.BT2020},
    7: Colorspace.SMPTE240M,
}
_WEIGHTS = {
    Colorspace.ITU709: "ITU-R BT.709",
    Colorspace.ITU601: "ITU-R BT.601",
    Colorspace.BT2020: "ITU-R BT.2020",
    Colorspace.SMPTE240M: "SMPTE-240M",
}
"""colour-science's names of the weights in luma."""
_SDR = 1
_LIKE_BT709 = (7, 11)  # the curves of SMPTE 240M and xvYCC, which differ from it by a hair or outside of it
_AS_IT_IS = (1, 6, 13, 14, 15)  # curves of SDR, which :func:`srgb_of` takes for the display's
_HD_WIDTH, _SD_HEIGHT = 1280, 576
_DOLBY_VISION = ("dvh1", "dvhe", "dvav", "dva1", "dav1")
_ACCURATE = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
_MEND = "convert it: ffmpeg -i VIDEO -vf 'zscale=m=709:p=709:t=709:r=limited' new.mp4, or export it in SDR"


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


class Frame(NamedTuple):
    """Decoded frame.

    Attributes:
        seconds: after the first frame.
        picture: PyAV's frame, as it is stored.
        turned: quarter turns, counter-clockwise, that make it upright.
        colors: its encoding.
    """

    seconds: float
    picture: av.VideoFrame
    turned: int
    colors: VideoColors

    def rgb(self) -> np.ndarray:
        """(H, W, 3) uint8 sRGB display values, upright."""
        return np.ascontiguousarray(np.rot90(displayed(self.picture, self.colors), self.turned))

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


def sizes_of(path: Path) -> list[tuple[int, int]]:
    """Width and height of each stream of pictures of a video.

    Raises:
        TronError: no such file, or no video in it.
    """
    with _opened(path) as container:
        _stream(container, path)
        return [(stream.width, stream.height) for stream in container.streams.video]


def frames_of(path: Path) -> Iterator[Frame]:
    """All frames of a video, one after another; a line says what becomes of colours that are not plain SDR.

    Raises:
        TronError: no such file, no video in it, a part that cannot be decoded, or colours that cannot.
    """
    with _opened(path) as container:
        stream = _stream(container, path)
        stream.thread_type = "AUTO"
        first = colors = None
        try:
            for picture in container.decode(stream):
                time = float(picture.time or 0.0)
                first = time if first is None else first
                colors = colors or _colors(picture, stream, path)
                yield Frame(time - first, picture, round((picture.rotation or 0) / 90) % 4, colors)
        except FFmpegError as error:
            raise TronError(f"video is damaged: {error.strerror}", path) from error


def _colors(picture: av.VideoFrame, stream: av.VideoStream, path: Path) -> VideoColors:
    with located(path):
        colors = colors_of(picture, stream.codec_context.codec_tag)
    said = colors.describe()
    if said is not None:
        (log.warning if colors.guessed else log.info)("%s: %s", path, said)
    return colors


def _opened(path: Path) -> InputContainer:
    try:
        return av.open(str(path), "r")
    except (FFmpegError, OSError) as error:
        raise TronError(f"not a readable video: {error.strerror}", path) from error


def _stream(container: InputContainer, path: Path) -> av.VideoStream:
    if not container.streams.video:
        raise TronError("file holds no video", path)
    return container.streams.video[0]


# Tags are code points of ITU-T H.273. Of plain SDR swscale undoes the YCbCr matrix, of all else
# colour-science; curves and primaries are those of :mod:`tron.io.color_spaces`. HLG and PQ are shown as
# SDR: diffuse white (203 cd/m2, BT.2408) becomes white, and what is brighter is clipped.
#
# What a stream does not say is taken as players take it: the matrix is that of BT.709 from 1280 columns or
# 577 rows on, of BT.601 below, of BT.2020 with its primaries; the primaries are those of BT.709, or of
# BT.2020 with its matrix, HLG or PQ; the curve is that of SDR and the range is limited.


class VideoColors(NamedTuple):
    """Encoding of a frame.

    Attributes:
        matrix: of YCbCr, for swscale; None: the frame holds RGB.
        full: whether values fill their range; limited leaves room below black and above white.
        primaries: code point of H.273.
        transfer: likewise.
        guessed: the tags that the stream lacks, named for messages.
    """

    matrix: Colorspace | None
    full: bool
    primaries: int
    transfer: int
    guessed: tuple[str, ...]

    def describe(self) -> str | None:
        """Fate of the colours, for the log; None of plain SDR, tagged."""
        matrix = (
            "RGB" if self.matrix is None else f"the matrix of {_WEIGHTS[self.matrix].removeprefix('ITU-R ')}"
        )
        names = f"{TRANSFERS[self.transfer]} in {PRIMARIES[self.primaries]}"
        if self.transfer in (HLG, PQ):
            return f"{names}, is shown as sRGB: diffuse white, 203 cd/m2, is its white; brighter is clipped"
        if self.guessed:
            what = f"{matrix}, {names}, {'full' if self.full else 'limited'} range"
            return f"does not say its {', '.join(self.guessed)}: taken for {what}"
        return None if self.primaries == 1 else f"{names}, is converted to sRGB"


def colors_of(picture: av.VideoFrame, codec_tag: str = "") -> VideoColors:
    """Colours of a frame by its tags, with the rule above for what they do not say.

    Args:
        picture: as it is decoded.
        codec_tag: four letters that the file names the codec by.

    Raises:
        TronError: a matrix, curve or primaries that are not converted, or Dolby Vision without a base layer.
    """
    matrix, primaries = int(picture.colorspace), int(picture.color_primaries)
    transfer = int(picture.color_trc)
    if codec_tag in _DOLBY_VISION and transfer in _UNSAID:
        raise TronError("Dolby Vision without a base layer that others can read (profile 5)", mend=_MEND)
    guessed = []
    if transfer in _UNSAID:
        transfer = _SDR
        guessed.append("transfer characteristic")
    transfer = _SDR if transfer in _LIKE_BT709 else transfer
    if primaries in _UNSAID:
        wide = matrix == _BT2020 or transfer in (HLG, PQ)
        primaries = _BT2020 if wide else 1
        guessed.append("primaries")
    rgb = picture.format.is_rgb
    if not rgb and matrix in _UNSAID:
        large = picture.width >= _HD_WIDTH or picture.height > _SD_HEIGHT
        matrix = _BT2020 if primaries == _BT2020 else (1 if large else 6)
        guessed.append("matrix")
    if not rgb and matrix not in _MATRICES:
        raise TronError(f"YCbCr matrix {matrix} of H.273 is not decoded", mend=_MEND)
    for code, known, what in (
        (transfer, TRANSFERS, "transfer characteristic"),
        (primaries, PRIMARIES, "primaries"),
    ):
        if code not in known:
            raise TronError(f"{what} {code} of H.273 cannot be shown in sRGB", mend=_MEND)
    full = picture.color_range == ColorRange.JPEG or picture.format.name.startswith("yuvj")
    return VideoColors(None if rgb else _MATRICES[matrix], full, primaries, transfer, tuple(guessed))


def displayed(picture: av.VideoFrame, colors: VideoColors) -> np.ndarray:
    """(H, W, 3) uint8 sRGB display values of a frame, as stored, of these colours."""
    span = ColorRange.JPEG if colors.full or colors.matrix is None else ColorRange.MPEG
    plain = colors.primaries == 1 and colors.transfer in _AS_IT_IS
    if plain or colors.matrix is None:
        rgb = picture.reformat(
            format="rgb24",
            src_colorspace=colors.matrix,
            src_color_range=span,
            dst_color_range=ColorRange.JPEG,
            interpolation=_ACCURATE,
        ).to_ndarray()
        if plain:
            return rgb
        values = rgb.astype(np.float32) / 255
    else:
        values = _rgb_of(picture, colors.matrix, span)
    return np.round(255 * srgb_of(values, colors.primaries, colors.transfer)).astype(np.uint8)


def _rgb_of(picture: av.VideoFrame, matrix: Colorspace, span: ColorRange) -> np.ndarray:
    """(H, W, 3) encoded RGB of a frame in YCbCr, white 1, to the last bit of its own.

    swscale brings chroma to full size and no more: its RGB of 16 bits is a step of 8 bits off.
    """
    colour = colour_science()
    bits = picture.format.components[0].bits
    wide = picture.reformat(
        format="yuv444p16le", src_color_range=span, dst_color_range=span, interpolation=_ACCURATE
    )
    codes = wide.to_ndarray().astype(np.float64) / 2 ** (16 - bits)
    return colour.YCbCr_to_RGB(
        codes,
        K=colour.WEIGHTS_YCBCR[_WEIGHTS[matrix]],
        in_bits=bits,
        in_legal=span == ColorRange.MPEG,
        in_int=True,
        out_legal=False,
        out_int=False,
    )
