"""Photographs, checked when a capture is loaded and decoded when they are looked at.

A photo is decoded, turned upright if it is to be, undistorted at its full size, reduced by area averaging and
kept at the reduced size, in the file's own 8 or 16 bits, in one cache of bounded size per capture.
"""

from __future__ import annotations

import io
import threading
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cachetools import LRUCache
from PIL import Image, UnidentifiedImageError

from tron.captures.distortion import Lens
from tron.errors import TronError
from tron.images import check_size

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")

_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")
_ORIENTATION_TAG = 0x0112
_TAIL_BYTES = 4096
_CHECK_SIDE = 64
_BIT_DEPTH_AT = 24
"""Byte of a PNG that holds its bit depth: behind signature, length and name of IHDR, width and height."""

Decode = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""What a map's file means: stored values (H, W, 3) and alpha (H, W), both in [0, 1] -> the map."""


@dataclass(frozen=True)
class PhotoHeader:
    """Header of a photo's file.

    Attributes:
        width: pixels as stored, before any turning.
        height: likewise.
        alpha: whether it has transparency.
        orientation: EXIF's 1 to 8; 1 is upright as stored.
    """

    width: int
    height: int
    alpha: bool = False
    orientation: int = 1

    def size(self, upright: bool) -> tuple[int, int]:
        """Width and height, of the photo turned as its EXIF tag says if ``upright``."""
        turned = upright and self.orientation >= 5
        return (self.height, self.width) if turned else (self.width, self.height)


def inspect_photo(path: Path) -> PhotoHeader:
    """Read a photo's header and make sure that its file is whole, without decoding it if that can be told.

    A JPEG or PNG that ends with its end marker is taken to be whole; any other file is decoded once.

    Raises:
        TronError: the file is missing, not such an image, cut short, damaged or too large.
    """
    try:
        with open(path, "rb") as file:
            n_bytes = file.seek(0, io.SEEK_END)
            file.seek(max(0, n_bytes - _TAIL_BYTES))
            tail = file.read()
            file.seek(0)
            with Image.open(file, formats=_FORMATS) as picture:
                check_size(*picture.size, len(picture.getbands()), n_bytes)
                header = PhotoHeader(
                    *picture.size,
                    alpha="A" in picture.getbands() or "transparency" in picture.info,
                    orientation=int(picture.getexif().get(_ORIENTATION_TAG, 1) or 1),
                )
                if not _has_end(picture.format or "", tail):
                    _decode_whole(path)
    except TronError as error:
        raise TronError(error.what, path, error.mend) from error
    except UnidentifiedImageError as error:
        raise TronError("not an image of a known format", path, f"use {', '.join(SUFFIXES)}") from error
    except OSError as error:
        raise TronError(f"cannot read image: {error.strerror or error}", path) from error
    except Exception as error:  # damaged files raise almost anything: SyntaxError, struct.error, ...
        raise TronError(f"not a readable image: {error}", path) from error
    return header


def _has_end(image_format: str, tail: bytes) -> bool:
    if image_format in ("JPEG", "MPO"):
        return tail.endswith(b"\xff\xd9")
    return image_format == "PNG" and b"IEND\xaeB`\x82" in tail


def _decode_whole(path: Path) -> None:
    # An interrupted copy may be filled up with zeros, which a decoder takes for grey.
    data = path.read_bytes().rstrip(b"\0") if path.suffix.lower() in (".jpg", ".jpeg") else path.read_bytes()
    with Image.open(io.BytesIO(data), formats=_FORMATS) as picture:
        picture.draft("RGB", (_CHECK_SIDE, _CHECK_SIDE))
        try:
            picture.load()
        except OSError as error:
            raise TronError(f"image is damaged or cut short: {error}") from error


class PhotoCache:
    """Decoded pixels under a key, the least recently used ones dropped beyond ``max_bytes``; thread-safe."""

    def __init__(self, max_bytes: int):
        self._kept: LRUCache[Hashable, Any] = LRUCache(max(1, max_bytes), getsizeof=_n_bytes)
        self._lock = threading.Lock()

    @property
    def n_bytes(self) -> int:
        """Bytes that are held now."""
        return int(self._kept.currsize)

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """An array or a tuple of arrays that is kept under ``key``, made now if it is not there."""
        with self._lock:
            if key in self._kept:
                return self._kept[key]
        value = make()
        with self._lock:
            if _n_bytes(value) <= self._kept.maxsize:
                self._kept[key] = value
        return value


def _n_bytes(value: Any) -> int:
    return sum(each.nbytes for each in value) if isinstance(value, tuple) else value.nbytes


@dataclass(frozen=True)
class PhotoReader:
    """Reads one photo as a view wants it.

    Attributes:
        path: the file.
        header: what it said when the capture was loaded; it is held to that.
        lens: undistorts it.
        size: width and height of what is read; not larger than the photo.
        cache: shared by the photos of a capture.
        upright: turn the photo as its EXIF tag says. Poses of files belong to the pixels as stored, hence no.
    """

    path: Path
    header: PhotoHeader
    lens: Lens
    size: tuple[int, int]
    cache: PhotoCache
    upright: bool = False

    def color(self) -> np.ndarray:
        """(H, W, 3) float32, stored values in [0, 1]; of a photo with alpha, straight (not premultiplied)."""
        pixels = self._pixels()
        return np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3]

    def alpha(self) -> np.ndarray:
        """(H, W) float32 in [0, 1]; 1 where the photo has none."""
        pixels = self._pixels()
        return pixels[..., 3] if pixels.shape[2] == 4 else np.ones(pixels.shape[:2], np.float32)

    def decoded(self, decode: Decode) -> np.ndarray:
        """A map that the file encodes."""
        return decode(self.color(), self.alpha())

    def _pixels(self) -> np.ndarray:
        """(H, W, 1, 3 or 4) float32 in [0, 1]."""
        stored = self.cache.get(self, self._read)
        return stored.astype(np.float32) / np.iinfo(stored.dtype).max

    def _read(self) -> np.ndarray:
        pixels = _decode(self.path, self.header)
        if self.upright:
            pixels = _turned(pixels, self.header.orientation)
        if pixels.shape[2] == 4:
            return self._resampled_under_alpha(pixels)
        return _area(self._undistort(pixels), self.size)

    def _resampled_under_alpha(self, pixels: np.ndarray) -> np.ndarray:
        """Resample straight colours weighted by alpha, so that hidden ones do not bleed in."""
        if not self.lens.distorts and self.size == pixels.shape[1::-1]:
            return pixels
        scale = np.iinfo(pixels.dtype).max
        weighted = pixels.astype(np.float32)
        weighted[..., :3] *= weighted[..., 3:] / scale
        weighted = _area(self._undistort(weighted), self.size)
        weighted[..., :3] *= scale / np.maximum(weighted[..., 3:], 1e-3)
        return np.clip(np.round(weighted), 0, scale).astype(pixels.dtype)

    def _undistort(self, pixels: np.ndarray) -> np.ndarray:
        if not self.lens.distorts:
            return pixels
        import cv2

        height, width = pixels.shape[:2]
        maps = self.cache.get((self.lens, width, height), lambda: self.lens.undistortion_maps(width, height))
        return cv2.remap(pixels, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _decode(path: Path, header: PhotoHeader) -> np.ndarray:
    """(H, W, 1, 3 or 4) uint8 or uint16 as stored, RGB or RGBA."""
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # damage is ours to report
    try:
        pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except OSError as error:
        raise TronError(f"cannot read image: {error.strerror or error}", path) from error
    except cv2.error as error:
        raise TronError(f"not a readable image: {error.err}", path) from error
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise TronError("image is damaged or has neither 8 nor 16 bits", path)
    if pixels.shape[:2] != (header.height, header.width):
        raise TronError("image has changed since the capture was loaded", path, "load the capture again")
    if pixels.ndim == 2:
        return _with_hidden_grey(path, pixels) if header.alpha else pixels[..., None]
    if pixels.shape[2] == 2:
        return np.concatenate([np.repeat(pixels[..., :1], 3, axis=2), pixels[..., 1:]], axis=2)
    swapped = cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(pixels, swapped)


def _with_hidden_grey(path: Path, pixels: np.ndarray) -> np.ndarray:
    """Grey (H, W) and the transparency that a PNG gives one of its values (chunk tRNS) -> RGBA, as stored.

    OpenCV passes over that chunk of grey files.
    """
    with Image.open(path, formats=("PNG",)) as picture:
        hidden = picture.info.get("transparency")
    alpha = np.full_like(pixels, np.iinfo(pixels.dtype).max)
    if isinstance(hidden, int):
        alpha[pixels == hidden * _steps_of_grey(path)] = 0
    return np.stack([pixels, pixels, pixels, alpha], axis=2)


def _steps_of_grey(path: Path) -> int:
    """Steps of 8 bits in one step of a grey PNG of 1, 2 or 4 bits, which is decoded to 8; else 1."""
    with open(path, "rb") as file:
        bits = file.read(_BIT_DEPTH_AT + 1)[_BIT_DEPTH_AT]
    return 255 // (2**bits - 1) if bits < 8 else 1


def _turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Follow EXIF's orientation tag: 2 to 4 mirror and turn by 180 degrees, 5 to 8 swap rows and columns."""
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def _area(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    if pixels.shape[1::-1] != size:
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return pixels[..., None] if pixels.ndim == 2 else pixels
