"""Views of photos: what can be read of each, under the capture's settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tron.captures.depth_files import DepthReader, require_depth
from tron.captures.distortion import Lens
from tron.captures.masks import MaskMeaning, beside_reduced, find_mask
from tron.captures.open_sky import open_sky
from tron.captures.photo_files import PhotoHeader, inspect_photo
from tron.captures.photographs import PhotoCache, PhotoReader
from tron.captures.posed_photos import PosedPhoto, rigid_pose
from tron.captures.settings import PhotoSettings
from tron.captures.view import View
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
    header = inspect_photo(path)
    if header.size(upright) != size:
        width, height = header.size(upright)
        raise TronError(f"{what} has {width} x {height} pixels, the photo {size[0]} x {size[1]}")
    return header
