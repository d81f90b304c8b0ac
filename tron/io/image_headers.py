"""Kind, size and shape of images, checked before anything is decoded or encoded."""

from __future__ import annotations

import struct

import numpy as np

from tron.errors import TronError

MAX_SIDE = 65_536
MAX_DECODED_BYTES = 2**31
"""A 16384 x 8192 environment map in float32 RGB fits."""

# A real image never expands a thousandfold as it is decoded; flat test images do, but are small.
_SMALL_DECODED_BYTES = 2**27
_MAX_EXPANSION = 1000

EXR_MAGIC = b"\x76\x2f\x31\x01"
HDR_MAGIC = (b"#?RADIANCE", b"#?RGBE")
JXL = (b"\xff\x0a", b"\0\0\0\x0cJXL ")
_RATIOS = {1: (1, 1), 2: (12, 10), 3: (4, 3), 4: (3, 2), 5: (16, 9), 6: (5, 4), 7: (2, 1)}
_BITS = (9, 13, 18, 30)
_BEGINNINGS = {
    "a web page (HTML)": (b"<!doctype html", b"<html", b"<head"),
    "an XML document": (b"<?xml",),
    "a pointer of Git LFS": (b"version https://git-lfs",),
    "JSON": (b"{", b"["),
    "a PNG image": (b"\x89png",),
    "a JPEG image": (b"\xff\xd8\xff",),
    "an OpenEXR image": (EXR_MAGIC,),
    "a Radiance HDR image": tuple(magic.lower() for magic in HDR_MAGIC),
    "a ZIP archive": (b"pk\x03\x04",),
    "gzip-compressed": (b"\x1f\x8b",),
}
"""Kinds of files that bear the wrong suffix, by the lower-case beginnings of such files."""
AGAIN = "copy or download it again"


def another_kind(wanted: str, data: bytes) -> TronError:
    """Error for a file that is not what its suffix says."""
    if not data.strip():
        return TronError(f"not {wanted}: the file is empty", mend=AGAIN)
    start = data[:256].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    found = next((kind for kind, starts in _BEGINNINGS.items() if start.startswith(starts)), None)
    if found is None:
        return TronError(f"not {wanted}")
    if found in ("a PNG image", "a JPEG image") and "PNG" in wanted:
        return TronError(f"{found[2:]} is damaged or cut short", mend=AGAIN)
    fetched = found.startswith(("a web page", "an XML", "a pointer", "JSON"))
    mend = "fetch the image itself" if fetched else "give it the suffix of what it is, or convert it"
    return TronError(f"not {wanted} but {found}", mend=mend)


def check_size(width: int, height: int, channels: int, file_bytes: int) -> None:
    """TronError if a header claims more pixels than are decoded here, or than the file's bytes can hold."""
    decoded = width * height * channels * 4
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and decoded <= MAX_DECODED_BYTES):
        raise TronError(f"image of {width} x {height} pixels and {channels} channels is too large")
    if decoded > max(_SMALL_DECODED_BYTES, _MAX_EXPANSION * file_bytes):
        raise TronError(f"{file_bytes} bytes claim to be an image of {width} x {height} pixels")


def shaped(image: np.ndarray, channels: tuple[int, ...]) -> np.ndarray:
    """The array as (H, W, C); TronError if it has another shape or number of channels."""
    image = np.asarray(image)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in channels or 0 in image.shape:
        raise TronError(f"an image must be (H, W, C) with C in {channels}, not {image.shape}")
    return image


def jpeg_xl_size(data: bytes) -> tuple[int, int]:
    """Width and height in pixels of a JPEG XL picture (ISO/IEC 18181-1, SizeHeader; 18181-2, boxes).

    Raises:
        TronError: the header is damaged.
    """
    start = 0 if data.startswith(JXL[0]) else _codestream(data)
    bits = int.from_bytes(data[start + 2 : start + 14], "little")

    def take(count: int) -> int:
        nonlocal bits
        value, bits = bits & (1 << count) - 1, bits >> count
        return value

    small = take(1)

    def side() -> int:
        return (take(5) + 1) * 8 if small else take(_BITS[take(2)]) + 1

    height, ratio = side(), take(3)
    if ratio:
        over, under = _RATIOS[ratio]
        return height * over // under, height
    return side(), height


def _codestream(data: bytes) -> int:
    """Where the codestream begins in a file of boxes."""
    at = 0
    while at + 16 <= len(data):
        size, kind, large = struct.unpack_from(">I4sQ", data, at)
        head = 16 if size == 1 else 8
        if kind in (b"jxlc", b"jxlp"):
            return at + head + (4 if kind == b"jxlp" else 0)
        size = large if size == 1 else size
        if size < head:
            break
        at += size
    raise TronError("JPEG XL picture is damaged or cut short", mend=AGAIN)
