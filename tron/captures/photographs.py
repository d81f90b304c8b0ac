"""Photographs, checked when a capture is loaded and decoded when they are looked at.

A photo is decoded, turned upright if it is to be, undistorted at its full size, reduced by area averaging and
kept at the reduced size, in the file's own 8 or 16 bits, in one cache of bounded size per capture.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cachetools import LRUCache

from tron.captures.distortion import Lens
from tron.captures.masks import MaskMeaning, mask_values
from tron.captures.photo_files import PhotoHeader, decode_photo

Decode = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""What a map's file means: stored values (H, W, 3) and alpha (H, W), both in [0, 1] -> the map."""


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
        mask: the photo is a mask, with this meaning (see :func:`tron.captures.masks.mask_values`).
        exposure: that a linear photo is shown with (see :func:`tron.captures.photo_files.shown`).
    """

    path: Path
    header: PhotoHeader
    lens: Lens
    size: tuple[int, int]
    cache: PhotoCache
    upright: bool = False
    mask: MaskMeaning | None = None
    exposure: float = 1.0

    def color(self) -> np.ndarray:
        """(H, W, 3) float32, stored values in [0, 1]; of a photo with alpha, straight (not premultiplied)."""
        pixels = self._pixels()
        return np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3]

    def alpha(self) -> np.ndarray:
        """(H, W) float32 in [0, 1]; 1 where the photo has none."""
        pixels = self._pixels()
        return pixels[..., 3] if pixels.shape[2] == 4 else np.ones(pixels.shape[:2], np.float32)

    def grey(self) -> np.ndarray:
        """(H, W) float32 in [0, 1]: the first channel."""
        return self._pixels()[..., 0]

    def decoded(self, decode: Decode) -> np.ndarray:
        """A map that the file encodes."""
        return decode(self.color(), self.alpha())

    def _pixels(self) -> np.ndarray:
        """(H, W, 1, 3 or 4) float32 in [0, 1]."""
        stored = self.cache.get(self, self._read)
        return stored.astype(np.float32) / np.iinfo(stored.dtype).max

    def _read(self) -> np.ndarray:
        pixels = decode_photo(self.path, self.header, self.exposure)
        if self.mask is not None:
            pixels = mask_values(pixels, self.mask)
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
