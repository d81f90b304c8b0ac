"""Views of photos: what can be read of each, under the capture's settings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tron.cameras import rigid_pose
from tron.captures.masks import MaskMeaning, beside_reduced, find_mask
from tron.captures.photos.depth_files import DepthReader, nearest, require_depth
from tron.captures.photos.panoramas import Face, Panorama
from tron.captures.photos.photo_files import PhotoHeader, inspect_photo
from tron.captures.photos.photographs import Decode, PhotoCache, PhotoReader, PosedPhoto
from tron.captures.settings import PhotoSettings
from tron.captures.view import Pixels, View
from tron.color import luminance, srgb_to_linear
from tron.errors import TronError
from tron.lenses import Lens

_SHAPE_TOLERANCE = 0.02

Size = tuple[int, int]


@dataclass(frozen=True)
class _Files:
    """A photo's own file and those that say more of its pixels, found and inspected.

    Attributes:
        photo: the photo, and ``header`` its header.
        mask: its mask and its header.
        maps: more images of the same pixels, with their headers and what they encode, by field.
        depth: its depth and the world units of one step.
    """

    photo: Path
    header: PhotoHeader
    mask: tuple[Path, PhotoHeader] | None
    maps: Mapping[str, tuple[Path, PhotoHeader, Decode]]
    depth: tuple[Path, float] | None


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
        masked: number of photos with a mask of their own file.
        notes: what is to be said of the photos' colours, counted.
        panoramas: number of photos that were cut into faces.
    """

    settings: PhotoSettings
    cache: PhotoCache
    upright: bool
    exposure: float
    lost_maps: list[str] = field(default_factory=list)
    reduced: list[tuple[Size, Size]] = field(default_factory=list)
    masked: int = 0
    notes: Counter[str] = field(default_factory=Counter)
    panoramas: int = 0

    def views(self, name: str, photo: PosedPhoto) -> list[View]:
        """The view of a photo, or six of a panorama, ``NAME/front`` and so on; read when they are looked at.

        Raises:
            TronError: the photo, its pose, its lens or its mask cannot be used.
        """
        if photo.refused or photo.lens is None:
            raise TronError(photo.refused or "no camera")
        if photo.path is None:
            raise TronError("image not found")
        pose = rigid_pose(photo.camera_to_world)
        header = inspect_photo(photo.path)
        self.notes.update(header.notes)
        size = header.size(self.upright)
        lens = _lens_of(photo, *size)
        mask = mask_of(photo.path, header, self.settings.masks, self.upright, photo.mask)
        files = _Files(
            photo.path, header, mask, self._maps_of(name, photo, size), self._depth_of(name, photo)
        )
        self.masked += mask is not None
        if not isinstance(lens, Panorama):
            return [self._view(name, files, lens, np.linalg.inv(pose))]
        self.panoramas += 1
        return [
            self._view(f"{name}/{face.name}", files, face, np.linalg.inv(pose @ face.to_panorama))
            for face in lens.faces
        ]

    def _view(self, name: str, files: _Files, lens: Lens | Face, world_to_camera: np.ndarray) -> View:
        camera = lens.camera(world_to_camera, *files.header.size(self.upright))
        full = (camera.width, camera.height)
        size = self.settings.size_of(*full)
        camera = camera.resized(*size)

        def reader(path: Path, header: PhotoHeader, **kind: Any) -> PhotoReader:
            return PhotoReader(
                path, header, lens, size, self.cache, self.upright, exposure=self.exposure, **kind
            )

        read = reader(files.photo, files.header)
        maps: dict[str, Pixels] = {
            field: partial(reader(path, header).decoded, decode)
            for field, (path, header, decode) in files.maps.items()
        }
        if files.depth is not None:
            maps["depth"] = DepthReader(*files.depth, lens, camera)
        if files.header.alpha:
            maps["mask"] = read.alpha
        if files.mask is not None:
            meaning = self.settings.masks
            maps["mask" if meaning == "subject" else "valid"] = reader(*files.mask, mask=meaning).grey
        if self.settings.sky and "mask" not in maps:
            maps |= {"sky_mask": partial(self._sky, read), "mask": partial(self._below_sky, read)}
        if size != full:
            self.reduced.append((full, size))
        return View(name, camera, read.color, "display", **maps)

    def _maps_of(
        self, name: str, photo: PosedPhoto, size: Size
    ) -> dict[str, tuple[Path, PhotoHeader, Decode]]:
        """More images of a photo's pixels that can be read, by field."""
        found = {}
        for field_name, (path, decode) in photo.maps.items():
            try:
                found[field_name] = (path, _of_size(path, size, self.upright, "image"), decode)
            except TronError as error:
                self.lost_maps.append(f"{field_name} of {name} ({error.what})")
        return found

    def _depth_of(self, name: str, photo: PosedPhoto) -> tuple[Path, float] | None:
        """File of a photo's depth and the world units of one step of it, if it can be read."""
        if photo.depth is None:
            return None
        try:
            require_depth(photo.depth)
        except TronError as error:
            self.lost_maps.append(f"depth of {name} ({error.what})")
            return None
        return photo.depth, self.settings.depth_unit * photo.depth_scale

    def _sky(self, read: PhotoReader) -> np.ndarray:
        """(H, W) float32, 1 where a photo shows the sky; a panorama is looked at as a whole."""
        if not isinstance(read.lens, Face):
            return self.cache.get((read, "sky"), lambda: open_sky(read.color())).astype(np.float32)
        side = min(2 * read.size[1], read.header.size(self.upright)[1])
        whole = replace(read, lens=read.lens.panorama, size=(2 * side, side))
        sky = self.cache.get((whole, "sky"), lambda: open_sky(whole.color()))
        return nearest(sky, read.lens.fractions(*read.size)).astype(np.float32)

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


def _lens_of(photo: PosedPhoto, width: int, height: int) -> Lens | Panorama:
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
