"""Views of photos: what can be read of each, under the capture's settings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tron.cameras import Camera, rigid_pose
from tron.captures.masks import MaskMeaning, beside_reduced, find_mask
from tron.captures.photos.distortion import Lens
from tron.captures.photos.photo_files import PhotoHeader, inspect_photo
from tron.captures.photos.photographs import PhotoCache, PhotoReader, PosedPhoto
from tron.captures.settings import PhotoSettings
from tron.captures.view import View
from tron.color import luminance, srgb_to_linear
from tron.errors import TronError

_SHAPE_TOLERANCE = 0.02

Size = tuple[int, int]


@dataclass
class PhotoViews:
    """Makes views of photos, and keeps what is to be told of all of them.

    Attributes:
        settings: of the photos.
        cache: of their pixels.
        upright: as in :class:`PosedPhotos`.
        exposure: of linear photos.
        lost_maps: maps that could not be read, and why.
        reduced: sizes before and after, of photos that are made smaller.
        masked: number of views with a mask of their own file.
    """

    settings: PhotoSettings
    cache: PhotoCache
    upright: bool
    exposure: float
    lost_maps: list[str] = field(default_factory=list)
    reduced: list[tuple[Size, Size]] = field(default_factory=list)
    masked: int = 0
    notes: Counter[str] = field(default_factory=Counter)

    def view(self, name: str, photo: PosedPhoto) -> View:
        """The view of a photo, which is read when it is looked at.

        Raises:
            TronError: the photo, its pose, its lens or its mask cannot be used.
        """
        if photo.refused or photo.lens is None:
            raise TronError(photo.refused or "no camera")
        if photo.path is None:
            raise TronError("image not found")
        world_to_camera = np.linalg.inv(rigid_pose(photo.camera_to_world))
        header = inspect_photo(photo.path)
        self.notes.update(header.notes)
        size = header.size(self.upright)
        lens = _lens_of(photo, *size)
        reduced = self.settings.size_of(*size)
        camera = lens.camera(world_to_camera, *size).resized(*reduced)

        def reader(path: Path, header: PhotoHeader, **kind: Any) -> PhotoReader:
            return PhotoReader(
                path, header, lens, reduced, self.cache, self.upright, exposure=self.exposure, **kind
            )

        read = reader(photo.path, header)
        maps = {}
        for map_name, (path, decode) in photo.maps.items():
            try:
                found = reader(path, _of_size(path, size, self.upright, "image"))
                maps[map_name] = partial(found.decoded, decode)
            except TronError as error:
                self.lost_maps.append(f"{map_name} of {name} ({error.what})")
        if photo.depth is not None:
            try:
                require_depth(photo.depth)
                unit = self.settings.depth_unit * photo.depth_scale
                maps["depth"] = DepthReader(photo.depth, unit, lens, camera)
            except TronError as error:
                self.lost_maps.append(f"depth of {name} ({error.what})")
        if header.alpha:
            maps["mask"] = read.alpha
        mask = mask_of(photo.path, header, self.settings.masks, self.upright, photo.mask)
        if mask is not None:
            meaning = self.settings.masks
            maps["mask" if meaning == "subject" else "valid"] = reader(*mask, mask=meaning).grey
            self.masked += 1
        if self.settings.sky and "mask" not in maps:
            maps |= {"sky_mask": partial(self._sky, read), "mask": partial(self._below_sky, read)}
        if reduced != size:
            self.reduced.append((size, reduced))
        return View(name, camera, read.color, "display", **maps)

    def _sky(self, read: PhotoReader) -> np.ndarray:
        """(H, W) float32, 1 where a photo shows the sky."""
        return self.cache.get((read, "sky"), lambda: open_sky(read.color())).astype(np.float32)

    def _below_sky(self, read: PhotoReader) -> np.ndarray:
        return 1 - self._sky(read)


def mask_of(
    photo: Path,
    header: PhotoHeader,
    meaning: MaskMeaning | None,
    upright: bool,
    named: Path | None = None,
) -> tuple[Path, PhotoHeader] | None:
    """The mask of a photo and its header; None where there is none or masks are not read.

    Args:
        photo: the photo's file.
        header: its header.
        meaning: of masks; None: they are not read.
        upright: the photo is turned as its EXIF tag says; the mask belongs to the turned one.
        named: the mask's file, where a file of poses names it.

    Raises:
        TronError: the photo has an alpha too, or the mask is absent, damaged or of another size.
    """
    path = None if meaning is None else beside_reduced(photo, named) or find_mask(photo)
    if path is None:
        return None
    if header.alpha:
        raise TronError("photo has alpha and a mask", mend="remove one of them, or give masks=null")
    if not path.is_file():
        raise TronError("mask not found")
    return path, _of_size(path, header.size(upright), upright, "mask")


def _lens_of(photo: PosedPhoto, width: int, height: int) -> Lens:
    assert photo.lens is not None
    lens = photo.lens(width, height) if callable(photo.lens) else photo.lens
    # Halved sizes are rounded, so shapes may differ by a pixel.
    if abs(width * lens.height - height * lens.width) > max(
        _SHAPE_TOLERANCE * width * lens.height, lens.width, lens.height
    ):
        raise TronError(
            f"image has {width} x {height} pixels, its intrinsics are for {lens.width:g} x {lens.height:g}"
        )
    return lens


def _of_size(path: Path, size: Size, upright: bool, what: str) -> PhotoHeader:
    """Header of an image of the photo's pixels; TronError if it has another size."""
    header = inspect_photo(path, color=False)
    if header.size(upright) != size:
        width, height = header.size(upright)
        raise TronError(f"{what} has {width} x {height} pixels, the photo {size[0]} x {size[1]}")
    return header


# Told from one upright photo, without a network. A white ceiling would pass for it, hence only who says that
# the photos were taken outdoors has them looked at. A sunset redder than the scene is bright, and a night's
# sky is neither bright nor blue: it stays what it is, a surface.

_BLUE = 1.1  # blue over red
_DARK = 0.02  # linear; darker pixels have no colour to speak of
_SMOOTH = 0.03  # display values from a pixel to the next
_ALIKE = 0.08  # the same, from the sky near by, at its rim
_RIM = 2
_NEAR = 15  # pixels a side over which the sky's colour is taken
_LEAST = 0.005


def sky_coloured(light: np.ndarray) -> np.ndarray:
    """(H, W) bool: brighter than half the picture, or blue, as skies are.

    Args:
        light: (H, W, 3) linear.
    """
    brightness = luminance(light)
    bright = brightness > np.median(brightness)
    blue = (light[..., 2] > _BLUE * light[..., 0]) & (light[..., 2] >= light[..., 1])
    return (bright | blue) & (brightness > _DARK)


def open_sky(image: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels that show nothing but the sky.

    Regions of sky-coloured pixels without edges are sky where they touch the upper edge and cover at least
    half a percent of the photo; they grow by two pixels over what has the colour of the sky near by, since
    windows that tell smoothness end before the skyline.

    Args:
        image: (H, W, 3) display values in [0, 1], upright.
    """
    import cv2

    grey = cv2.blur(np.ascontiguousarray(image.mean(2), np.float32), (3, 3))
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
    coloured = sky_coloured(srgb_to_linear(image))
    labels = cv2.connectedComponents((coloured & (slope < _SMOOTH)).astype(np.uint8), connectivity=4)[1]
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0  # of what is no candidate
    at_edge = np.unique(labels[0])
    sky = np.isin(labels, at_edge[sizes[at_edge] >= _LEAST * labels.size])
    if not sky.any():
        return sky
    share = cv2.blur(sky.astype(np.float32), (_NEAR, _NEAR))
    near = cv2.blur(image.astype(np.float32) * sky[..., None], (_NEAR, _NEAR)) / share[..., None].clip(1e-3)
    alike = (np.abs(image - near).max(2) < _ALIKE) & coloured
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for _ in range(_RIM):
        sky |= (cv2.dilate(sky.astype(np.uint8), cross) > 0) & alike
    return sky


_DEPTH_SUFFIXES = (".png", ".npy")


@dataclass(frozen=True)
class DepthReader:
    """Reads the depth of one photo as its view wants it.

    Nothing is averaged, for between a near and a far surface there is none: each pixel takes the depth that
    lies nearest to its centre. The file may be smaller than the photo, as a phone's lidar is.

    Attributes:
        path: 16-bit PNG or .npy of (H, W) numbers, 0 where nothing is known.
        unit: world units of one step.
        lens: of the photo.
        camera: of the view.
    """

    path: Path
    unit: float
    lens: Lens
    camera: Camera

    def __call__(self) -> np.ndarray:
        """(H, W) float32 distance from the camera along each pixel's ray, world units.

        Raises:
            TronError: no such file, or one that holds no depth of this photo.
        """
        stored = _read(self.path)
        width, height = self.camera.width, self.camera.height
        if abs(stored.shape[1] * height - stored.shape[0] * width) > max(
            _SHAPE_TOLERANCE * width * stored.shape[0], width, height
        ):
            raise TronError(
                f"depth has {stored.shape[1]} x {stored.shape[0]} pixels, its view {width} x {height}",
                self.path,
            )
        columns, rows = _centres(self.lens, width, height)
        along_axis = stored[
            _nearest(rows / height, stored.shape[0]), _nearest(columns / width, stored.shape[1])
        ]
        cosine = self.camera.rays() @ self.camera.forward
        return (along_axis * self.unit / cosine).astype(np.float32)


def require_depth(path: Path) -> None:
    """Raise TronError unless there is a depth file of a kind that is read; it is not decoded."""
    if path.suffix.lower() not in _DEPTH_SUFFIXES:
        raise TronError("depth in an unknown format", path, f"use {', '.join(_DEPTH_SUFFIXES)}")
    if not path.is_file():
        raise TronError("not found", path)


def _centres(lens: Lens, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows, (height, width) each, in the stored photo as if it had this size."""
    if not lens.distorts:
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        return columns, rows
    places = lens.places(width, height)
    return places[..., 0], places[..., 1]


def _nearest(fraction: np.ndarray, count: int) -> np.ndarray:
    return np.clip((fraction * count).astype(int), 0, count - 1)


def _read(path: Path) -> np.ndarray:
    """(H, W) float64, finite and not negative."""
    try:
        depth = _READERS[path.suffix.lower()](path)
    except (OSError, ValueError, EOFError) as error:
        raise TronError(f"not a readable depth file: {error}", path) from error
    if depth is None or depth.ndim not in (2, 3) or depth.dtype.kind not in "uif":
        raise TronError("depth file holds no numbers of one channel", path)
    depth = depth.reshape(*depth.shape[:2], -1)
    if depth.shape[2] != 1 or depth.size == 0 or depth.dtype == np.uint8:
        raise TronError("depth file has several channels or 8 bits", path, "store 16 bits of one channel")
    return np.nan_to_num(depth[..., 0].astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0).clip(0)


def _png(path: Path) -> np.ndarray | None:
    import cv2

    return cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)


_READERS: dict[str, Callable[[Path], np.ndarray | None]] = {
    ".png": _png,
    ".npy": lambda path: np.load(path, allow_pickle=False),
}
