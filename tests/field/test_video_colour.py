"""Videos in the colours that phones and camcorders write: frames are the sRGB that was filmed, or a line."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
import pytest

from tron.errors import TronError
from tron.io.video import VideoWriter, frames_of
from tron.seeds import generator

WEIGHTS = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}
"""Shares of red and blue in luma, by H.273's matrices (ITU-R BT.709, BT.601, BT.2020)."""
TO_BT2020 = np.array(
    [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]
)  # BT.2087
TO_P3 = np.array([[0.82246, 0.17754, 0], [0.03319, 0.96681, 0], [0.01708, 0.07240, 0.91052]])
BLOCK = 16


class Kind(NamedTuple):
    """How a video is encoded, and how it is tagged."""

    tags: Sequence[int]  # primaries, transfer, matrix
    encoded: Sequence[int]  # likewise
    bits: int = 8
    full: bool = False
    size: tuple[int, int] = (96, 64)
    says: str | None = None


HD = (1280, 32)
KINDS = {
    "plain": Kind((1, 1, 1), (1, 1, 1)),
    "sRGB": Kind((1, 13, 1), (1, 1, 1)),
    "full range": Kind((1, 1, 1), (1, 1, 1), full=True),
    "BT.601, PAL's matrix": Kind((1, 6, 5), (1, 1, 5)),
    "BT.601, NTSC's matrix, xvYCC": Kind((1, 11, 6), (1, 1, 6)),
    "BT.601 in HD": Kind((1, 1, 5), (1, 1, 5), size=HD),
    "BT.601, full range": Kind((1, 1, 5), (1, 1, 5), full=True),
    "BT.709 in SD": Kind((1, 1, 1), (1, 1, 1)),
    "nothing said, SD": Kind((2, 2, 2), (1, 1, 5), says="does not say its transfer characteristic"),
    "nothing said, HD": Kind((2, 2, 2), (1, 1, 1), size=HD, says="the matrix of BT.709"),
    "matrix unsaid, SD": Kind(
        (1, 1, 2), (1, 1, 5), says="does not say its matrix: taken for the matrix of BT.601"
    ),
    "BT.2020 of SDR": Kind((9, 14, 9), (9, 1, 9), 10, says="BT.2020 in BT.2020, is converted to sRGB"),
    "BT.2020, curve unsaid": Kind((9, 2, 9), (9, 1, 9), 10, says="does not say its transfer characteristic"),
    "Display P3": Kind((12, 13, 1), (12, 1, 1), says="sRGB in Display P3, is converted to sRGB"),
    "HLG": Kind((9, 18, 9), (9, 18, 9), 10, says="HLG in BT.2020, is shown as sRGB"),
    "HLG, full range": Kind((9, 18, 9), (9, 18, 9), 10, full=True, says="HLG"),
    "HLG, primaries unsaid": Kind((2, 18, 9), (9, 18, 9), 10, says="HLG in BT.2020"),
    "HLG, matrix unsaid": Kind((9, 18, 2), (9, 18, 9), 10, says="HLG in BT.2020"),
    "PQ": Kind((9, 16, 9), (9, 16, 9), 10, says="PQ in BT.2020"),
    "PQ, 12 bits": Kind((9, 16, 9), (9, 16, 9), 12, says="PQ in BT.2020"),
}


def linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def curve(light: np.ndarray, transfer: int) -> np.ndarray:
    """Encoded values of linear light, 1 the white of SDR, by BT.2100's formulas; sRGB's for SDR."""
    if transfer == 16:  # PQ: inverse EOTF of cd/m2
        m1, m2, c1, c2, c3 = 1305 / 8192, 2523 / 32, 107 / 128, 2413 / 128, 2392 / 128
        y = (np.maximum(light, 0) * 203 / 10000) ** m1
        return ((c1 + c2 * y) / (1 + c3 * y)) ** m2
    if transfer == 18:  # HLG: inverse OOTF of a display of 1000 cd/m2, gamma 1.2, then the OETF
        shown = np.maximum(light, 0) * 203 / 1000
        scene = shown * np.maximum(shown @ [0.2627, 0.6780, 0.0593], 1e-9)[..., None] ** (1 / 1.2 - 1)
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        return np.where(scene <= 1 / 12, np.sqrt(3 * scene), a * np.log(np.maximum(12 * scene - b, 1e-9)) + c)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def planes(srgb: np.ndarray, kind: Kind) -> list[np.ndarray]:
    """Y, Cb and Cr, 4:2:0, of an sRGB picture (H, W, 3) in [0, 1], written out."""
    primaries, transfer, matrix = kind.encoded
    to = {1: np.eye(3), 9: TO_BT2020, 12: TO_P3}[primaries]
    rgb = curve(linear(srgb) @ to.T, transfer)
    red, blue = WEIGHTS[matrix]
    y = rgb @ [red, 1 - red - blue, blue]
    cb, cr = (rgb[..., 2] - y) / (2 * (1 - blue)), (rgb[..., 0] - y) / (2 * (1 - red))
    cb, cr = map(subsampled, (cb, cr))
    most, unit = 2**kind.bits - 1, 2 ** (kind.bits - 8)
    if kind.full:
        levels = y * most, cb * most + 128 * unit, cr * most + 128 * unit
    else:
        levels = (219 * y + 16) * unit, (224 * cb + 128) * unit, (224 * cr + 128) * unit
    return [np.clip(np.round(each), 0, most) for each in levels]


def subsampled(chroma: np.ndarray) -> np.ndarray:
    """Half of the rows and columns, each at the left column of two and between the rows, as MPEG-2 has it."""
    rows = chroma.reshape(chroma.shape[0] // 2, 2, -1).mean(1)
    wide = np.pad(rows, ((0, 0), (1, 1)), mode="edge")
    return (wide[:, :-2:2] + 2 * wide[:, 1:-1:2] + wide[:, 2::2]) / 4


def film(path: Path, srgb: np.ndarray, kind: Kind, codec: str = "ffv1", frames: int = 1) -> Path:
    """Encode without loss (FFV1), or with another codec."""
    width, height = srgb.shape[1::-1]
    layout, dtype = ("yuv420p", "u1") if kind.bits == 8 else (f"yuv420p{kind.bits}le", "<u2")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=24)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = width, height, layout
        context = stream.codec_context
        context.color_primaries, context.color_trc, context.colorspace = kind.tags
        context.color_range = 2 if kind.full else 1
        for index in range(frames):
            frame = av.VideoFrame(width, height, layout)
            for plane, values in zip(frame.planes, planes(srgb, kind)):
                rows = np.zeros((values.shape[0], plane.line_size // np.dtype(dtype).itemsize), dtype)
                rows[:, : values.shape[1]] = values
                plane.update(rows.tobytes())
            frame.pts = index
            frame.color_primaries, frame.color_trc, frame.colorspace = kind.tags
            frame.color_range = 2 if kind.full else 1
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def patches(size: tuple[int, int]) -> np.ndarray:
    """Blocks of random colours, black, grey and white, (H, W, 3) in [0, 1].

    No channel is nearly empty beside a full one: there a step of 10 bits in BT.2020 is ten of sRGB's 255.
    """
    rows, columns = size[1] // BLOCK, size[0] // BLOCK
    colors = generator(0, "patches").integers(64, 240, (rows * columns, 3)) / 255
    colors[:3] = np.array([0, 0.5, 1])[:, None]
    return np.repeat(np.repeat(colors.reshape(rows, columns, 3), BLOCK, 0), BLOCK, 1)


def inside(picture: np.ndarray) -> np.ndarray:
    """The pixels in the middle of the blocks: chroma of 4:2:0 blurs their edges."""
    at = np.arange(picture.shape[0]) % BLOCK, np.arange(picture.shape[1]) % BLOCK
    rows, columns = (np.flatnonzero((each >= 5) & (each < BLOCK - 5)) for each in at)
    return picture[np.ix_(rows, columns)]


@pytest.mark.parametrize("name", KINDS)
def test_frames_are_the_colours_that_were_filmed(tmp_path: Path, caplog, name: str) -> None:
    kind = KINDS[name]
    srgb = patches(kind.size)
    path = film(tmp_path / "a.mkv", srgb, kind)
    with caplog.at_level(logging.INFO, "tron"):
        (frame,) = frames_of(path)
        found = frame.rgb()
    assert np.abs(inside(found) - 255 * inside(srgb)).max() <= 2  # 8 bits of limited range cost as much
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == (kind.says is not None), lines
    assert all(kind.says in line and str(path) in line for line in lines)


def test_frames_of_hlg_are_those_of_the_sdr_twin(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.linspace(0, 1, 192), np.linspace(0, 1, 128))
    waves = [np.sin(2 * np.pi * (x + b * y)) for b in (1, -1, 2)]
    srgb = np.round(255 * (0.55 + 0.2 * np.stack(waves, -1))) / 255
    hlg, sdr = (
        next(frames_of(film(tmp_path / f"{name}.mkv", srgb, KINDS[name]))).rgb() for name in ("HLG", "plain")
    )
    apart = hlg.astype(float) - sdr
    assert np.abs(apart).max() <= 2
    assert np.abs(apart.mean((0, 1))).max() < 0.2


def test_what_is_brighter_than_white_is_clipped(tmp_path: Path) -> None:
    kind = KINDS["HLG"]
    bright = np.full((32, 32, 3), 1.5)  # as sRGB's curve continues: 2.5 times the light of white
    (frame,) = frames_of(film(tmp_path / "a.mkv", bright, kind))
    assert frame.rgb().min() == 255


@pytest.mark.parametrize(
    ("tags", "said"),
    [
        ((1, 1, 8), "YCbCr matrix 8"),
        ((9, 16, 14), "YCbCr matrix 14"),
        ((9, 16, 10), "YCbCr matrix 10"),
        ((1, 9, 1), "transfer characteristic 9"),
        ((10, 1, 1), "primaries 10"),
    ],
)
def test_colours_that_are_not_converted_are_one_line(
    tmp_path: Path, tags: tuple[int, ...], said: str
) -> None:
    path = film(tmp_path / "a.mkv", patches((32, 64)), Kind(tags, (1, 1, 1)))
    with pytest.raises(TronError, match=said) as caught:
        next(frames_of(path))
    assert str(path) in str(caught.value)
    assert "ffmpeg" in str(caught.value)


@pytest.mark.parametrize(("tags", "readable"), [((2, 2, 2), False), ((9, 18, 9), True)])
def test_dolby_vision_is_read_by_its_base_layer_alone(
    tmp_path: Path, tags: tuple[int, ...], readable: bool
) -> None:
    kind = Kind(tags, (9, 18, 9), 10)
    path = film(tmp_path / "a.mp4", patches((96, 64)), kind, "libx264")
    path.write_bytes(path.read_bytes().replace(b"avc1", b"dvav"))
    if readable:  # iPhones' profile 8.4: HLG with metadata beside it
        assert next(frames_of(path)).colors.transfer == 18
    else:
        with pytest.raises(TronError, match="Dolby Vision"):
            next(frames_of(path))


@pytest.mark.parametrize("size", [(96, 64), HD], ids=["SD", "HD"])
def test_what_we_write_is_encoded_as_it_is_tagged(tmp_path: Path, size: tuple[int, int]) -> None:
    srgb = patches(size)
    with VideoWriter(tmp_path / "a.mp4", 24, size) as video:
        video.write(srgb)
    assert b"colrnclx\x00\x01\x00\x01\x00\x01\x00" in (tmp_path / "a.mp4").read_bytes()  # BT.709, limited
    with av.open(str(tmp_path / "a.mp4")) as container:
        picture = next(container.decode(video=0))
    assert (picture.color_primaries, picture.color_trc, picture.colorspace, picture.color_range) == (
        1,
        1,
        1,
        1,
    )
    stored = np.asarray(picture.to_ndarray()[: size[1]], float)
    luma = planes(srgb, KINDS["plain"])[0]
    assert np.abs(inside(stored) - inside(luma)).max() <= 2


def test_the_clip_that_was_reported(shared_data: Path) -> None:
    clip = shared_data / "field" / "hdr-video" / "phone_hdr.mov"
    photo = shared_data / "field" / "georeferenced-capture" / "images" / "IMG_0000.jpg"
    if not (clip.is_file() and photo.is_file()):
        pytest.skip(f"{clip} is absent")
    from PIL import Image

    found = next(frames_of(clip)).rgb().astype(float)
    filmed = np.asarray(Image.open(photo).convert("RGB").resize((384, 384), Image.Resampling.BICUBIC), float)
    assert (
        np.abs((found - filmed).mean((0, 1))).max() < 1
    )  # both are compressed; pixel by pixel 1.8 on average
    assert np.median(np.abs(found - filmed)) <= 1
