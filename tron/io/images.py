"""Images in and out: OpenEXR and Radiance HDR hold linear values, PNG and JPEG display values in [0, 1].

Arrays are float32 and (H, W, C) with the first row at the top, in linear BT.709 or sRGB: a file that says it
is in another colour space is converted, with a line in the log, but where a caller says that it is no colour.
OpenCV decodes the run lengths of today's Radiance files, the rest is done here, after Ward's "Radiance File
Formats": XYZE, old run lengths and files without FORMAT are refused by OpenCV 5 and OpenImageIO 3.2, which do
not apply PRIMARIES and EXPOSURE either.

Input is not trusted: sizes are read from the header and refused before anything is decoded.
"""

from __future__ import annotations

import io
import os
import re
import warnings
from pathlib import Path

import numpy as np
from PIL import Image, PngImagePlugin, UnidentifiedImageError

from tron.errors import TronError, located, say_once
from tron.io.color_spaces import XYZ, radiance_in_bt709
from tron.io.embedded_colors import DisplayColors, colors_of_file
from tron.io.exr_files import decode_exr, encode_exr, open_exr
from tron.io.image_headers import AGAIN, MAX_DECODED_BYTES, MAX_SIDE, another_kind, check_size, shaped
from tron.storage import write_atomic

__all__ = [
    "MAX_SIDE",
    "SUFFIXES",
    "check_size",
    "decode_exr",
    "decode_png",
    "encode_exr",
    "encode_jpeg",
    "encode_png",
    "read_image",
    "write_image",
]

SUFFIXES = (".exr", ".hdr", ".png", ".jpg", ".jpeg")

# Pillow warns of large images; ours are held to the limits above before anything is decoded.
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)

_JPEG_QUALITY = 95
_PNG_DEPTH_AT = 24
"""Byte of a PNG that holds its bit depth: behind signature, length and name of IHDR, width and height."""
_BEGINNING = b"#?"
_LONGEST_HEADER = 65_536
_RESOLUTION = re.compile(rb"([-+])([XY]) +(\d{1,9}) +([-+])([XY]) +(\d{1,9})[ \t]*\r?\n")
_FORMATS = {"": False, "32-bit_rle_rgbe": False, "32-bit_rle_xyze": True}
"""Values of FORMAT, and whether they mean CIE XYZ; files without the line hold RGB."""
_NEW_RUNS = (8, 0x7FFF)
"""Least and greatest width of scanlines with run lengths by channel."""


def read_image(path: str | os.PathLike[str], channels: int | None = 3, color: bool = True) -> np.ndarray:
    """Read an image as (H, W, C) float32: linear from .exr and .hdr, display in [0, 1] from .png and .jpg.

    Args:
        path: the file; its suffix says its format.
        channels: 1, 3 or 4 channels are made of what the file holds (grey is repeated, alpha dropped or added
            as 1, equal RGB taken as grey), or None for the file's own.
        color: whether RGB is colour, to be brought from what the file says to BT.709; not of normals, of
            roughness or of masks.

    Raises:
        TronError: the file is missing, unreadable, not an image, too large, or cannot give ``channels``.
    """
    path = Path(path)
    suffix = _suffix(path)
    try:
        size = path.stat().st_size
        if size > MAX_DECODED_BYTES:
            raise TronError(f"image file of {size / 1e9:.1f} GB is too large", path)
        data = path.read_bytes()
    except OSError as error:
        raise TronError(f"cannot read image: {error.strerror or error}", path) from error
    with located(path):
        if suffix == ".exr":
            image, notes = open_exr(data, color)
        elif suffix == ".hdr":
            image, notes = open_radiance(data)
        else:
            image, notes = _open_display(data, color)
        image = _with_channels(image, channels)
    for note in notes:
        say_once(__name__, f"{path}: {note}")
    return image


def write_image(
    path: str | os.PathLike[str], image: np.ndarray, half: bool = True, color: bool = True
) -> None:
    """Write an image, whole or not at all; the suffix chooses the format.

    Args:
        path: .exr (PIZ) and .hdr take linear values, .png and .jpg display values, clipped to [0, 1].
        image: (H, W), (H, W, 1), (H, W, 3) or, for EXR and PNG, (H, W, 4), any float type, or uint8 for PNG
            and JPEG.
        half: store EXR in 16 bits; values beyond 65504 are then stored as 65504. Use False for lights.
        color: whether RGB is colour, which the file then says: BT.709 in EXR, sRGB in PNG.

    Raises:
        TronError: unknown suffix, unsuitable shape, or the file cannot be written.
    """
    suffix = _suffix(Path(path))
    if suffix == ".exr":
        data = encode_exr(image, half, color)
    elif suffix == ".hdr":
        data = encode_radiance(image)
    else:
        data = encode_png(image, color) if suffix == ".png" else encode_jpeg(image)
    write_atomic(path, data)


def encode_png(image: np.ndarray, color: bool = True) -> bytes:
    """Encode display values in [0, 1] (clipped), or uint8, of 1, 3 or 4 channels as an 8-bit PNG.

    RGB is tagged as sRGB where it is ``color``.
    """
    levels = _levels(shaped(image, (1, 3, 4)))
    tags = PngImagePlugin.PngInfo()
    if color and levels.ndim == 3:
        tags.add(b"sRGB", b"\0")  # perceptual, as PNG's specification has it for pictures
    stream = io.BytesIO()
    Image.fromarray(levels).save(stream, "PNG", pnginfo=tags)
    return stream.getvalue()


def encode_jpeg(image: np.ndarray, quality: int = _JPEG_QUALITY) -> bytes:
    """Encode display values in [0, 1] (clipped), or uint8, of 1 or 3 channels as a JPEG; quality 1 to 95."""
    stream = io.BytesIO()
    Image.fromarray(_levels(shaped(image, (1, 3)))).save(stream, "JPEG", quality=quality)
    return stream.getvalue()


def _levels(image: np.ndarray) -> np.ndarray:
    """(H, W) or (H, W, C) uint8 of display values."""
    if image.dtype != np.uint8:
        image = np.round(np.clip(np.nan_to_num(image, nan=0.0), 0, 1) * 255).astype(np.uint8)
    return image[..., 0] if image.shape[2] == 1 else image


def decode_png(data: bytes) -> np.ndarray:
    """Decode a PNG or JPEG to (H, W, C) float32 sRGB display values in [0, 1], without a word.

    Orientation tags are not applied.

    Raises:
        TronError: not such an image, damaged, too large, or of a colour space that is not converted.
    """
    return _open_display(data, color=True)[0]


def _open_display(data: bytes, color: bool) -> tuple[np.ndarray, list[str]]:
    """The image of :func:`decode_png`, and what is to be said of it."""
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as picture:
            check_size(*picture.size, len(picture.getbands()), len(data))
            colors = colors_of_file(picture, data) if color else DisplayColors()
            pixels = colors.srgb(stored_pixels(picture, data, colors.inks))
            notes = colors.notes()
    except TronError:
        raise
    except UnidentifiedImageError as error:
        raise another_kind("a PNG or JPEG image", data) from error
    except Exception as error:  # damaged files raise almost anything: OSError, SyntaxError, struct.error, ...
        raise TronError(f"not a readable PNG or JPEG image: {error}") from error
    return pixels.astype(np.float32) / np.iinfo(pixels.dtype).max, notes


def stored_pixels(picture: Image.Image, data: bytes, inks: bool = False) -> np.ndarray:
    """(H, W, 1, 3 or 4) uint8 or uint16 as stored, of a picture that Pillow has opened, of these bytes.

    Palettes become RGB, and so does CMYK unless its ``inks`` are wanted.
    """
    if picture.mode.startswith("I"):  # 16 bits of grey
        return np.asarray(picture).astype(np.uint16)[..., None]
    if picture.format == "PNG" and data[_PNG_DEPTH_AT : _PNG_DEPTH_AT + 1] == b"\x10":
        return _sixteen_bits(data)
    if picture.mode == "CMYK" and inks:
        return np.asarray(picture)
    if picture.mode not in ("L", "RGB", "RGBA"):
        picture = picture.convert("RGBA" if picture.has_transparency_data else "RGB")
    pixels = np.asarray(picture)
    return pixels.reshape(*pixels.shape[:2], -1)


def _sixteen_bits(data: bytes) -> np.ndarray:
    """(H, W, 3 or 4) uint16 of a PNG, by OpenCV: Pillow keeps 8 bits of its colours."""
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # damage is ours to report
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 3:
        raise TronError("PNG image is damaged or cut short", mend=AGAIN)
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB)


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise TronError("unknown image format", path, f"use one of {', '.join(SUFFIXES)}")
    return suffix


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


def open_radiance(data: bytes) -> tuple[np.ndarray, list[str]]:
    """Decode Radiance HDR to (H, W, 3) float32, linear BT.709, upright, and what is to be said of it.

    EXPOSURE and COLORCORR, each a product over its lines, are divided by; PRIMARIES are brought to BT.709 by
    Bradford's adaptation. XYZE is CIE XYZ and is not adapted.

    Raises:
        TronError: not such a file, damaged, too large, another FORMAT, or a header's number that means
            nothing.
    """
    if not data.startswith(_BEGINNING):
        raise another_kind("a Radiance HDR image", data)
    fields, match = _header(data)
    slow_sign, slow, fast_sign, fast = match[1], match[2], match[4], match[5]
    if slow == fast:
        raise TronError("Radiance HDR image has two axes of one name", mend=AGAIN)
    rows, columns = int(match[3]), int(match[6])
    check_size(columns, rows, 3, len(data))
    image = _pixels(data[match.end() :], rows, columns)
    if slow == b"X":
        image = image.transpose(1, 0, 2)
    up, left = (slow_sign, fast_sign) if slow == b"Y" else (fast_sign, slow_sign)
    image = image[:: -1 if up == b"+" else 1, :: -1 if left == b"-" else 1]
    image, notes = _linear(image, fields)
    return np.ascontiguousarray(image, np.float32), notes


def encode_radiance(image: np.ndarray) -> bytes:
    """Encode linear (H, W, 1 or 3) as Radiance HDR, three equal channels of one."""
    import cv2

    image = shaped(image, (1, 3)).astype(np.float32)
    rgb = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image
    return cv2.imencode(".hdr", np.ascontiguousarray(rgb[..., ::-1]))[1].tobytes()


def _header(data: bytes) -> tuple[dict[str, list[str]], re.Match[bytes]]:
    """Values of each name in the header, and the line that says size and orientation."""
    end = re.search(rb"\n\r?\n", data[:_LONGEST_HEADER])
    resolution = end and _RESOLUTION.match(data, end.end())
    if not end or not resolution:
        raise TronError("Radiance HDR image is damaged or cut short in its header", mend=AGAIN)
    fields: dict[str, list[str]] = {}
    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
        name, equals, value = line.partition("=")
        if equals:
            fields.setdefault(name.strip().upper(), []).append(value.strip())
    return fields, resolution


def _linear(image: np.ndarray, fields: dict[str, list[str]]) -> tuple[np.ndarray, list[str]]:
    """Linear BT.709 of pixels as stored, by the header's fields."""
    kind = fields.get("FORMAT", [""])[-1].lower()
    if kind not in _FORMATS:
        raise TronError(f"Radiance HDR image has FORMAT={kind}", mend="store it as 32-bit_rle_rgbe")
    notes = []
    divisor = np.ones(3)
    for name, count in (("EXPOSURE", 1), ("COLORCORR", 3)):
        for value in fields.get(name, []):
            divisor = divisor * _numbers(name, value, count)
    if not ((divisor > 0) & np.isfinite(divisor)).all():
        raise TronError("Radiance HDR image has an EXPOSURE or COLORCORR that is not above zero")
    if (divisor != 1).any():
        named = " and ".join(name for name in ("EXPOSURE", "COLORCORR") if name in fields)
        shown = ", ".join(f"{value:.4g}" for value in np.unique(divisor))
        notes.append(f"radiance is divided by its {named} ({shown})")
        image = image / divisor.astype(np.float32)
    if _FORMATS[kind]:
        return radiance_in_bt709(image, XYZ), [*notes, "colours are brought from XYZ to BT.709"]
    if "PRIMARIES" in fields:
        space = _numbers("PRIMARIES", fields["PRIMARIES"][-1], 8)
        # Photoshop writes eight zeros, which state nothing.
        converted = radiance_in_bt709(image, space.tolist()) if space.any() else image
        if converted is not image:
            notes.append("colours are brought from its PRIMARIES to BT.709")
        image = converted
    if any(value not in ("1", "1.0") for value in fields.get("GAMMA", [])):
        notes.append(f"GAMMA={fields['GAMMA'][-1]} is not looked at: read as linear")
    return image, notes


def _numbers(name: str, value: str, count: int) -> np.ndarray:
    try:
        numbers = np.array([float(word) for word in value.split()])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != count:
        raise TronError(f"Radiance HDR image has {name}={value[:80]}", mend=f"give {count} numbers")
    return numbers


def _pixels(payload: bytes, rows: int, columns: int) -> np.ndarray:
    """(rows, columns, 3) float32 as stored, in the order of the file."""
    runs = payload[:2] == b"\x02\x02" and len(payload) > 3 and payload[2] < 128
    if not (runs and _NEW_RUNS[0] <= columns <= _NEW_RUNS[1]):
        return _of_rgbe(_old_runs(payload, rows * columns)).reshape(rows, columns, 3)
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # damage is ours to report
    known = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (rows, columns)
    try:
        pixels = cv2.imdecode(np.frombuffer(known + payload, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise TronError(f"not a readable Radiance HDR image: {error.err}") from error
    if pixels is None or pixels.shape != (rows, columns, 3):
        raise TronError("Radiance HDR image is damaged or cut short", mend=AGAIN)
    return np.asarray(pixels[..., ::-1], np.float32)


def _old_runs(payload: bytes, count: int) -> np.ndarray:
    """(count, 4) uint8: pixels as they are, or with run lengths of pixels.

    A pixel whose mantissas are all 1 repeats the one before it as often as its exponent says; of several in a
    row each counts 256 times as much as the one before.
    """
    values = np.frombuffer(payload[: len(payload) // 4 * 4], np.uint8).reshape(-1, 4)
    if len(values) >= count:
        whole = values[:count]
        if len(values) == count or not (whole[:, :3] == 1).all(1).any():
            return whole
    run = (values[:, :3] == 1).all(1)
    at = np.arange(len(values))
    since = at - np.maximum.accumulate(np.where(run, -1, at))  # runs since the last pixel
    repeats = np.where(run, values[:, 3].astype(np.int64) << np.minimum(8 * (since - 1), 24).clip(0), 1)
    total = np.minimum(np.cumsum(repeats), count)
    if run[:1].any() or not len(total) or total[-1] < count:
        raise TronError("Radiance HDR image is damaged or cut short", mend=AGAIN)
    source = np.maximum.accumulate(np.where(run, -1, at))
    return np.repeat(values[source], np.diff(total, prepend=0), axis=0)


def _of_rgbe(pixels: np.ndarray) -> np.ndarray:
    """(..., 3) float32 of mantissas and their common exponent, as OpenCV and Mitsuba have it."""
    scale = np.ldexp(np.float32(1), pixels[..., 3:].astype(np.int32) - 136)
    return np.where(pixels[..., 3:] > 0, pixels[..., :3] * scale, 0).astype(np.float32)
