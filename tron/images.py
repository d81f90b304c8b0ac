"""Images in and out: OpenEXR and Radiance HDR hold linear values, PNG and JPEG display values in [0, 1].

No colour conversion is made here: what is in the file is what the array holds, float32 and (H, W, C) with the
first row at the top. Input is not trusted: sizes are read from the header and refused before anything is
decoded.
"""

from __future__ import annotations

import io
import os
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from tron.errors import TronError
from tron.storage import write_atomic

SUFFIXES = (".exr", ".hdr", ".png", ".jpg", ".jpeg")

MAX_SIDE = 65_536
MAX_DECODED_BYTES = 2**31
"""A 16384 x 8192 environment map in float32 RGB fits."""

# A real image never expands a thousandfold as it is decoded; flat test images do, but are small.
_SMALL_DECODED_BYTES = 2**27
_MAX_EXPANSION = 1000

# Pillow warns of large images; ours are held to the limits above before anything is decoded.
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)

_EXR_MAGIC = b"\x76\x2f\x31\x01"
_HDR_MAGIC = (b"#?RADIANCE", b"#?RGBE")
_BEGINNINGS = {
    "a web page (HTML)": (b"<!doctype html", b"<html", b"<head"),
    "an XML document": (b"<?xml",),
    "a pointer of Git LFS": (b"version https://git-lfs",),
    "JSON": (b"{", b"["),
    "a PNG image": (b"\x89png",),
    "a JPEG image": (b"\xff\xd8\xff",),
    "an OpenEXR image": (_EXR_MAGIC,),
    "a Radiance HDR image": tuple(magic.lower() for magic in _HDR_MAGIC),
    "a ZIP archive": (b"pk\x03\x04",),
    "gzip-compressed": (b"\x1f\x8b",),
}
"""Kinds of files that bear the wrong suffix, by the lower-case beginnings of such files."""
_AGAIN = "copy or download it again"
_HALF_MAX = 65504.0
_JPEG_QUALITY = 95


def read_image(path: str | os.PathLike[str], channels: int | None = 3) -> np.ndarray:
    """Read an image as (H, W, C) float32: linear from .exr and .hdr, display in [0, 1] from .png and .jpg.

    Args:
        path: the file; its suffix says its format.
        channels: 1, 3 or 4 channels are made of what the file holds (grey is repeated, alpha dropped or added
            as 1, equal RGB taken as grey), or None for the file's own.

    Raises:
        TronError: the file is missing, unreadable, not an image, too large, or cannot give ``channels``.
    """
    path = Path(path)
    decode = {".exr": decode_exr, ".hdr": _decode_hdr}.get(_suffix(path), decode_png)
    try:
        size = path.stat().st_size
        if size > MAX_DECODED_BYTES:
            raise TronError(f"image file of {size / 1e9:.1f} GB is too large", path)
        data = path.read_bytes()
    except OSError as error:
        raise TronError(f"cannot read image: {error.strerror or error}", path) from error
    try:
        return _with_channels(decode(data), channels)
    except TronError as error:
        raise TronError(error.what, path, error.mend) from error


def write_image(path: str | os.PathLike[str], image: np.ndarray, half: bool = True) -> None:
    """Write an image, whole or not at all; the suffix chooses the format.

    Args:
        path: .exr (PIZ) and .hdr take linear values, .png and .jpg display values, clipped to [0, 1].
        image: (H, W), (H, W, 1), (H, W, 3) or, for EXR and PNG, (H, W, 4), any float type, or uint8 for PNG
            and JPEG.
        half: store EXR in 16 bits; values beyond 65504 are then stored as 65504. Use False for lights.

    Raises:
        TronError: unknown suffix, unsuitable shape, or the file cannot be written.
    """
    suffix = _suffix(Path(path))
    if suffix == ".exr":
        data = encode_exr(image, half)
    elif suffix == ".hdr":
        data = _encode_hdr(image)
    else:
        data = _encode_display(image, "PNG" if suffix == ".png" else "JPEG")
    write_atomic(path, data)


def encode_exr(image: np.ndarray, half: bool = True) -> bytes:
    """Encode linear (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) as OpenEXR scanlines with PIZ compression.

    NaN and infinity are stored as they are; finite values beyond half's range saturate at 65504. The same
    input gives the same bytes.
    """
    import OpenEXR

    image = _shaped(image, (1, 3, 4))
    if half:
        saturated = np.where(np.isfinite(image), np.clip(image, -_HALF_MAX, _HALF_MAX), image)
        image = saturated.astype(np.float16)
    else:
        image = image.astype(np.float32)
    name, pixels = {1: ("Y", image[..., 0]), 3: ("RGB", image), 4: ("RGBA", image)}[image.shape[2]]
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    OpenEXR.File(header, {name: np.ascontiguousarray(pixels)}).write(stream)
    return stream.getvalue()


def decode_exr(data: bytes) -> np.ndarray:
    """Decode OpenEXR to (H, W, C) float32, linear: RGB, RGBA, or the single channel of a one-channel file.

    Raises:
        TronError: not an OpenEXR file, damaged, several parts, deep or cropped pixels, other channels, or too
            large.
    """
    import OpenEXR

    if not data.startswith(_EXR_MAGIC):
        raise _another_kind("an OpenEXR image", data)
    try:
        parts = OpenEXR.File(io.BytesIO(data), header_only=True).parts
        _check_exr_header(parts, len(data))
        decoded = OpenEXR.File(io.BytesIO(data))
        if not decoded.parts:  # the binding drops a part that it cannot decode
            raise TronError("OpenEXR image is damaged or cut short", mend=_AGAIN)
        pixels = {name: channel.pixels for name, channel in decoded.channels().items()}
    except TronError:
        raise
    except Exception as error:  # the binding raises RuntimeError, ValueError and others for damaged files
        raise TronError(f"not a readable OpenEXR image: {error}") from error
    image = next((pixels[name] for name in ("RGB", "RGBA", "Y") if name in pixels), None)
    if image is None and len(pixels) == 1:
        image = next(iter(pixels.values()))
    if image is None or image.dtype not in (np.float16, np.float32):
        raise TronError(
            f"OpenEXR image has channels {', '.join(pixels)}", mend="store R, G, B or a single channel"
        )
    return np.ascontiguousarray(image.reshape(*image.shape[:2], -1), dtype=np.float32)


def _check_exr_header(parts: list[Any], file_bytes: int) -> None:
    if len(parts) != 1:
        raise TronError(f"OpenEXR file has {len(parts)} parts", mend="store one image a file")
    header = parts[0].header
    (x0, y0), (x1, y1) = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
    check_size(int(x1 - x0 + 1), int(y1 - y0 + 1), len(header["channels"]), file_bytes)
    if "deep" in str(header.get("type", "")):
        raise TronError("OpenEXR file has deep pixels", mend="flatten it")
    if not np.array_equal(header["dataWindow"], header["displayWindow"]):
        raise TronError(
            "OpenEXR file is cropped: data and display window differ", mend="store the full frame"
        )


def encode_png(image: np.ndarray) -> bytes:
    """Encode display values in [0, 1] (clipped), or uint8, of 1, 3 or 4 channels as an 8-bit PNG."""
    return _encode_display(image, "PNG")


def encode_jpeg(image: np.ndarray, quality: int = _JPEG_QUALITY) -> bytes:
    """Encode display values in [0, 1] (clipped), or uint8, of 1 or 3 channels as a JPEG; quality 1 to 95."""
    return _encode_display(image, "JPEG", quality)


def decode_png(data: bytes) -> np.ndarray:
    """Decode a PNG or JPEG to (H, W, C) float32 display values in [0, 1]; orientation tags are not applied.

    Raises:
        TronError: not such an image, damaged or too large.
    """
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as picture:
            check_size(*picture.size, len(picture.getbands()), len(data))
            if picture.mode.startswith("I"):  # 16 bits of grey
                return np.asarray(picture, dtype=np.float32)[..., None] / 65535
            if picture.mode not in ("L", "RGB", "RGBA"):
                transparent = "A" in picture.getbands() or "transparency" in picture.info
                picture = picture.convert("RGBA" if transparent else "RGB")
            pixels = np.asarray(picture, dtype=np.float32) / 255
    except TronError:
        raise
    except UnidentifiedImageError as error:
        raise _another_kind("a PNG or JPEG image", data) from error
    except Exception as error:  # damaged files raise almost anything: OSError, SyntaxError, struct.error, ...
        raise TronError(f"not a readable PNG or JPEG image: {error}") from error
    return pixels.reshape(*pixels.shape[:2], -1)


def _encode_display(image: np.ndarray, file_format: str, quality: int = _JPEG_QUALITY) -> bytes:
    image = _shaped(image, (1, 3, 4) if file_format == "PNG" else (1, 3))
    if image.dtype != np.uint8:
        image = np.round(np.clip(np.nan_to_num(image, nan=0.0), 0, 1) * 255).astype(np.uint8)
    stream = io.BytesIO()
    Image.fromarray(image[..., 0] if image.shape[2] == 1 else image).save(
        stream, file_format, **({"quality": quality} if file_format == "JPEG" else {})
    )
    return stream.getvalue()


def _decode_hdr(data: bytes) -> np.ndarray:
    import cv2

    if not data.startswith(_HDR_MAGIC):
        raise _another_kind("a Radiance HDR image", data)
    header = re.match(rb"#\?\w+\s.{0,65536}?\n\n-Y (\d{1,9}) \+X (\d{1,9})\n", data, re.DOTALL)
    if not header:
        turned = re.match(rb"#\?\w+\s.{0,65536}?\n\n[-+][XY] \d+ [-+][XY] \d+\n", data, re.DOTALL)
        if not turned:
            raise TronError("Radiance HDR image is damaged or cut short in its header", mend=_AGAIN)
        raise TronError("Radiance HDR image is turned", mend="rows must run from top to bottom (-Y H +X W)")
    height, width = int(header[1]), int(header[2])
    check_size(width, height, 3, len(data))
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # damage is ours to report
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise TronError(f"not a readable Radiance HDR image: {error.err}") from error
    if pixels is None or pixels.shape != (height, width, 3):
        raise TronError("Radiance HDR image is damaged or cut short", mend=_AGAIN)
    return np.ascontiguousarray(pixels[..., ::-1], dtype=np.float32)


def _encode_hdr(image: np.ndarray) -> bytes:
    import cv2

    image = _shaped(image, (1, 3)).astype(np.float32)
    rgb = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image
    return cv2.imencode(".hdr", np.ascontiguousarray(rgb[..., ::-1]))[1].tobytes()


def _another_kind(wanted: str, data: bytes) -> TronError:
    """Error for a file that is not what its suffix says."""
    if not data.strip():
        return TronError(f"not {wanted}: the file is empty", mend=_AGAIN)
    start = data[:256].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    found = next((kind for kind, starts in _BEGINNINGS.items() if start.startswith(starts)), None)
    if found is None:
        return TronError(f"not {wanted}")
    if found in ("a PNG image", "a JPEG image") and "PNG" in wanted:
        return TronError(f"{found[2:]} is damaged or cut short", mend=_AGAIN)
    fetched = found.startswith(("a web page", "an XML", "a pointer", "JSON"))
    mend = "fetch the image itself" if fetched else "give it the suffix of what it is, or convert it"
    return TronError(f"not {wanted} but {found}", mend=mend)


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise TronError("unknown image format", path, f"use one of {', '.join(SUFFIXES)}")
    return suffix


def _shaped(image: np.ndarray, channels: tuple[int, ...]) -> np.ndarray:
    image = np.asarray(image)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in channels or 0 in image.shape:
        raise TronError(f"an image must be (H, W, C) with C in {channels}, not {image.shape}")
    return image


def check_size(width: int, height: int, channels: int, file_bytes: int) -> None:
    """TronError if a header claims more pixels than are decoded here, or than the file's bytes can hold."""
    decoded = width * height * channels * 4
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and decoded <= MAX_DECODED_BYTES):
        raise TronError(f"image of {width} x {height} pixels and {channels} channels is too large")
    if decoded > max(_SMALL_DECODED_BYTES, _MAX_EXPANSION * file_bytes):
        raise TronError(f"{file_bytes} bytes claim to be an image of {width} x {height} pixels")


def _with_channels(image: np.ndarray, channels: int | None) -> np.ndarray:
    have = image.shape[2]
    if channels is None or channels == have:
        return image
    if channels not in (1, 3, 4):
        raise ValueError(f"channels must be 1, 3, 4 or None, not {channels}")
    color = image if have in (1, 3) else image[..., : have - 1]
    if channels == 1:
        if color.shape[2] == 3 and not (color == color[..., :1]).all():
            raise TronError("a grey image is needed here, and this one has colours")
        return np.ascontiguousarray(color[..., :1])
    rgb = np.repeat(color, 3, axis=2) if color.shape[2] == 1 else color
    if channels == 4:
        alpha = image[..., have - 1 :] if have in (2, 4) else np.ones_like(image[..., :1])
        rgb = np.concatenate([rgb, alpha], axis=2)
    return np.ascontiguousarray(rgb)
