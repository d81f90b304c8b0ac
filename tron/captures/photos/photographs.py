"""Photographs, checked when a capture is loaded and decoded when they are looked at.

A photo is decoded, turned upright if it is to be, undistorted at its full size, reduced by area averaging and
kept at the reduced size, in the file's own 8 or 16 bits, in one cache of bounded size per capture.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from cachetools import LRUCache

from tron.captures.masks import MaskMeaning, mask_values
from tron.captures.photos.panoramas import Face, Panorama, bordered
from tron.captures.photos.photo_files import PhotoHeader, decode_photo
from tron.lenses import Lens

_OVERSAMPLED = 3
"""A panorama is reduced to so many times the resolution of the faces, before these are cut out."""
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
        lens: undistorts it, or cuts a face out of it; a whole panorama is read as it is.
        size: width and height of what is read; not larger than the photo.
        cache: shared by the photos of a capture.
        upright: turn the photo as its EXIF tag says. Poses of files belong to the pixels as stored, hence no.
        mask: the photo is a mask, with this meaning (see :func:`tron.captures.masks.mask_values`).
        exposure: that a linear photo is shown with (see :func:`tron.captures.photos.photo_files.shown`).
    """

    path: Path
    header: PhotoHeader
    lens: Lens | Face | Panorama
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
        if isinstance(self.lens, Face):
            stored = self.cache.get((self.lens.panorama, replace(self, lens=self.lens.panorama)), self._cut)
            stored = stored[self.lens.index]
        else:
            stored = self.cache.get(self, lambda: self._reduced(self._decoded()))
        return stored.astype(np.float32) / np.iinfo(stored.dtype).max

    def _cut(self) -> tuple[np.ndarray, ...]:
        """All faces of the panorama, cut at once: decoding it takes longer.

        It is reduced before that as far as leaves the faces three times as fine as they are wanted, but not
        with alpha, for the colours that it hides must not bleed in.
        """
        assert isinstance(self.lens, Face)
        pixels = self._decoded()
        height = min(pixels.shape[0], round(_OVERSAMPLED * self.size[1] * np.pi / 2))
        if pixels.shape[2] != 4:
            pixels = _area(pixels, (2 * height, height))
        pixels = bordered(pixels)
        return tuple(replace(self, lens=face)._reduced(pixels) for face in self.lens.panorama.faces)

    def _decoded(self) -> np.ndarray:
        pixels = decode_photo(self.path, self.header, self.exposure)
        if self.mask is not None:
            pixels = mask_values(pixels, self.mask)
        if self.upright:
            pixels = _turned(pixels, self.header.orientation)
        return pixels

    def _reduced(self, pixels: np.ndarray) -> np.ndarray:
        """What is read of the whole photo's pixels (H, W, C): undistorted, or a face, at ``size``."""
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
        if isinstance(self.lens, Panorama) or not self.lens.distorts:
            return pixels
        import cv2

        lens, (height, width) = self.lens, pixels.shape[:2]
        maps = self.cache.get((lens, width, height), lambda: lens.undistortion_maps(width, height))
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


@dataclass(frozen=True)
class PosedPhoto:
    """Photo as its file describes it; nothing is checked yet.

    Attributes:
        name: as the file has it.
        path: the image, None if it was not found.
        camera_to_world: matrix to the capture's world, OpenCV camera axes; anything (4, 4) or (3, 4).
        lens: of the photo, or what gives the lens for a photo of this width and height; a panorama becomes
            six views.
        split: whether the file holds the photo out; None where it does not say.
        maps: more images of the same pixels, by field of :class:`View`, with what they encode.
        refused: why the photo cannot be used, if the file itself shows that.
        mask: that the file names; None: one is looked for beside the photo (see :func:`find_mask`).
        depth: file of the photo's depth (see :mod:`tron.captures.photos.depth_files`), whose units are
            ``depth_scale`` times the user's.
        depth_scale: world units of the capture in one of the file's.
    """

    name: str
    path: Path | None
    camera_to_world: object
    lens: Lens | Panorama | Callable[[int, int], Lens | Panorama] | None
    split: Literal["train", "test"] | None = None
    maps: Mapping[str, tuple[Path, Decode]] = field(default_factory=dict)
    refused: str | None = None
    mask: Path | None = None
    depth: Path | None = None
    depth_scale: float = 1.0


@dataclass(frozen=True)
class PosedPhotos:
    """Photos and points of a file of poses; fields as in :class:`Capture`.

    Attributes:
        source: the file or folder, for messages.
        upright: the poses belong to photos turned as their EXIF tags say.
        names: of the views, in the order of photos; None names them after their images.
        up: (3,) unit, that the format states; None: it is estimated from the cameras.
    """

    source: Path
    photos: Sequence[PosedPhoto]
    points: np.ndarray | None = None
    point_colors: np.ndarray | None = None
    transform: np.ndarray = field(default_factory=lambda: np.eye(4))
    skipped: Mapping[str, str] = field(default_factory=dict)
    upright: bool = False
    names: Sequence[str] | None = None
    up: np.ndarray | None = None
