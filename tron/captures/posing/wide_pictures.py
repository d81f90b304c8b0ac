"""Photos and frames without poses that no pinhole made: equirectangular ones of 360 degrees, and discs.

An equirectangular picture is twice as wide as high and says so (Google's GPano in XMP), or its left edge goes
on at its right and one row at a pole is one place. A phone's 2:1 photo does neither. Fisheye lenses and raw
files of 360 cameras leave black corners round one disc, or two side by side: they have to be stitched first.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path

import numpy as np
from PIL import Image

from tron.captures.photos.photo_files import PhotoHeader
from tron.errors import TronError
from tron.io.video import sizes_of

_HEAD = 1 << 20
_TAG = re.compile(rb'GPano:(\w+)(?:\s*=\s*["\']|\s*>)\s*([^"\'<]{1,60})')
_MOST_TOLD = 1 << 26
_SIDE = 128
"""Rows of the copies that are looked at."""
_SEAM, _LEVELS = 2.0, 2.0
"""Times the difference of neighbouring columns, and levels of 8 bits beside, that the edges may differ by."""
_POLE = 0.5
"""Standard deviation of a pole's row in that of the picture."""
_AGREE = 0.7
"""Share of the 2:1 photos of one size that must look all around: others are alike by chance."""
_SAMPLED = 12
_BLACK, _OUTSIDE, _INSIDE = 20, 0.97, 0.85
"""Levels up to which a pixel is black, and shares of black outside of a disc, of others inside."""
_RIM = 0.06
"""Of the radius on both sides that neither counts for."""

Open = Callable[[Path], Image.Image]


def equirectangular(photos: Mapping[Path, PhotoHeader], open_photo: Open) -> set[Path]:
    """Those of some photos that show all around from one place.

    Args:
        photos: with their headers.
        open_photo: gives a photo as it is stored.

    Raises:
        TronError: a photo says that it is a panorama of another projection, or of a part of the sphere.
    """
    found, candidates = set(), {}
    for path, header in photos.items():
        width, height = header.size(upright=True)
        if _says(path, width, height):
            found.add(path)
        elif abs(width - 2 * height) <= 1:
            candidates.setdefault((width, height), []).append(path)
    for alike in candidates.values():
        chosen = [alike[k] for k in _spread(len(alike))]
        if np.mean([_goes_round(_small(open_photo(path), 2 * _SIDE)) for path in chosen]) >= _AGREE:
            found |= set(alike)
    return found


def refuse_discs(photos: Collection[Path], open_photo: Open) -> None:
    """Raise TronError if photos are discs in black: circular fisheyes, or both lenses of a 360 camera.

    Args:
        photos: of one capture, three or more; what is black in all of some of them is outside.
        open_photo: gives a photo as it is stored.
    """
    paths = sorted(photos)
    by_size: dict[tuple[int, int], list[np.ndarray]] = {}
    for k in _spread(len(paths)):
        picture = open_photo(paths[k])
        seen = _small(picture, max(1, round(_SIDE * picture.width / picture.height)))
        by_size.setdefault(picture.size, []).append(seen.max(-1))
    brightest = [np.max(group, axis=0) for group in by_size.values() if len(group) >= 3]
    count = min((found for each in brightest if (found := _discs(each))), default=0)
    if count:
        kind = (
            "two fisheye pictures side by side, a 360 camera's raw file" if count > 1 else "circular fisheyes"
        )
        mend = "stitch them to equirectangular pictures (2:1) with the camera's program first"
        if count == 1:
            mend = "give them with calibrated poses (COLMAP's OPENCV_FISHEYE), or undistort them first"
        raise TronError(f"these are {kind}", paths[0].parent, mend)


def refuse_video(path: Path) -> None:
    """Raise TronError if a video's container says that its frames are not seen from one place as they are.

    Raw files of 360 cameras have a stream a lens. Google's spherical metadata (V1, XML; V2, boxes st3d and
    sv3d) tell of two eyes in one picture, and of other projections than the equirectangular one.
    """
    sizes = sizes_of(path)
    if len(sizes) > 1 and sizes[0] == sizes[1] and sizes[0][0] > 0:
        mend = "stitch it to an equirectangular one (2:1) with the camera's program first"
        raise TronError("a video of two streams of one size, a 360 camera's raw file", path, mend)
    told = _movie_box(path)
    eyes = told.find(b"st3d")
    stereo = eyes >= 0 and told[eyes + 8 : eyes + 9] not in (b"", b"\0")
    if stereo or re.search(rb"GSpherical:StereoMode>\s*(top|left)", told):
        mend = "export one eye as an equirectangular video (2:1)"
        raise TronError("a video of two eyes in one picture", path, mend)
    projection = re.search(rb"sv3d.{0,400}?(cbmp|mshp)", told, re.DOTALL)
    if projection is not None:
        kind = {b"cbmp": "a cube map", b"mshp": "a mesh of its own"}[projection[1]]
        mend = "convert it to equirectangular: ffmpeg -i VIDEO -vf v360=eac:e new.mp4"
        raise TronError(f"a video of 360 degrees in the projection of {kind}", path, mend)


def _movie_box(path: Path) -> bytes:
    """Content of an MP4's box moov, which holds all that is told of its streams; empty of other files."""
    try:
        with path.open("rb") as stream:
            size = path.stat().st_size
            at = 0
            while at + 16 <= size:
                stream.seek(at)
                length, kind, large = struct.unpack(">I4sQ", stream.read(16))
                length = large if length == 1 else length or size - at
                if kind == b"moov":
                    stream.seek(at)
                    return stream.read(min(length, _MOST_TOLD))
                if length < 8:
                    break
                at += length
    except (OSError, struct.error):
        pass
    return b""


def _says(path: Path, width: int, height: int) -> bool:
    """Whether a photo's XMP says that it is a whole equirectangular one."""
    with path.open("rb") as stream:
        tags = {
            name.decode(): value.strip().decode("latin-1") for name, value in _TAG.findall(stream.read(_HEAD))
        }
    kind = tags.get("ProjectionType")
    if kind is None:
        return False
    whole = abs(width - 2 * height) <= 1
    for side in ("Width", "Height"):
        full, part = tags.get(f"FullPano{side}Pixels"), tags.get(f"CroppedAreaImage{side}Pixels")
        whole = whole and (full is None or part is None or full == part)
    if kind.lower() != "equirectangular" or not whole:
        what = (
            "of a part of the sphere"
            if kind.lower() == "equirectangular"
            else f"in the projection {kind[:30]}"
        )
        raise TronError(
            f"a panorama {what}", path, "whole equirectangular ones (2:1) are read: leave this one out"
        )
    return True


def _goes_round(small: np.ndarray) -> bool:
    """Whether a picture (H, 2 H, 3) goes on at its other edge, and has a place for a row at a pole."""
    grey = small.mean(-1)
    apart = np.abs(np.diff(grey, axis=1)).mean(0)
    seam = float(np.abs(grey[:, 0] - grey[:, -1]).mean())
    poles = min(float(grey[0].std()), float(grey[-1].std()))
    return seam <= _SEAM * float(apart.mean()) + _LEVELS and poles <= _POLE * float(grey.std()) + _LEVELS


def _discs(brightest: np.ndarray) -> int:
    """Discs that a picture (H, W) consists of, one or two side by side; 0 of any other.

    Args:
        brightest: level of each pixel, the most in several photos.
    """
    height, width = brightest.shape
    if _disc(brightest):
        return 1
    half = width // 2
    sides = (brightest[:, :half], brightest[:, width - half :])
    return 2 if abs(width - 2 * height) <= 0.1 * height and all(map(_disc, sides)) else 0


def _disc(brightest: np.ndarray) -> bool:
    """Whether all but a disc in the middle, nearly as high or wide as the picture, is black."""
    height, width = brightest.shape
    y, x = np.ogrid[:height, :width]
    lit = brightest > _BLACK
    columns, rows = np.flatnonzero(lit.mean(0) > 0.02), np.flatnonzero(lit.mean(1) > 0.02)
    if not len(columns) or not len(rows):
        return False
    radius = 0.5 * max(np.ptp(columns), np.ptp(rows)) + 0.5
    middle = 0.5 * (columns[0] + columns[-1]), 0.5 * (rows[0] + rows[-1])
    if not 0.45 * min(height, width) <= radius <= 0.55 * max(height, width):
        return False
    if max(abs(middle[0] - width / 2) / width, abs(middle[1] - height / 2) / height) > 0.1:
        return False
    away = np.hypot(x - middle[0], y - middle[1]) / radius
    outside, inside = away > 1 + _RIM, away < 1 - _RIM
    corners = outside.mean() > 0.1
    return bool(corners and (~lit[outside]).mean() > _OUTSIDE and lit[inside].mean() > _INSIDE)


def _small(picture: Image.Image, width: int) -> np.ndarray:
    """(H, W, 3) levels of a reduced copy."""
    with picture:
        picture.draft("RGB", (2 * width, 2 * _SIDE))
        scale = min(1.0, picture.height / _SIDE)
        size = round(width * scale), round(_SIDE * scale)
        small = picture.convert("RGB").resize(size, Image.Resampling.BOX)
        return np.asarray(small, np.float32)


def _spread(count: int) -> Iterable[int]:
    """Some numbers from 0 to ``count`` - 1, evenly."""
    return sorted({int(k) for k in np.linspace(0, count - 1, min(count, _SAMPLED))}) if count else ()
