"""From what a file says of its photos to a capture: what cannot be used is left out, counted and named."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from tron.captures.capture import Capture
from tron.captures.distortion import Lens
from tron.captures.image_folder import view_names
from tron.captures.orientation import estimate_up
from tron.captures.photo_files import PhotoHeader, exposure_of, inspect_photo, require_decoders
from tron.captures.photographs import Decode, PhotoCache, PhotoReader
from tron.captures.settings import PhotoSettings
from tron.captures.view import View
from tron.errors import TronError

log = logging.getLogger(__name__)

_SHAPE_TOLERANCE = 0.02
_SHOWN = 5


@dataclass(frozen=True)
class PosedPhoto:
    """Photo as its file describes it; nothing is checked yet.

    Attributes:
        name: as the file has it.
        path: the image, None if it was not found.
        camera_to_world: matrix to the capture's world, OpenCV camera axes; anything (4, 4) or (3, 4).
        lens: of the photo, or what gives the lens for a photo of this width and height.
        split: whether the file holds the photo out; None where it does not say.
        maps: more images of the same pixels, by field of :class:`View`, with what they encode.
        refused: why the photo cannot be used, if the file itself shows that.
    """

    name: str
    path: Path | None
    camera_to_world: object
    lens: Lens | Callable[[int, int], Lens] | None
    split: Literal["train", "test"] | None = None
    maps: Mapping[str, tuple[Path, Decode]] = field(default_factory=dict)
    refused: str | None = None


@dataclass(frozen=True)
class PosedPhotos:
    """Photos and points of a file of poses; fields as in :class:`Capture`.

    Attributes:
        source: the file or folder, for messages.
        upright: the poses belong to photos turned as their EXIF tags say.
        names: of the views, in the order of photos; None names them after their images.
    """

    source: Path
    photos: Sequence[PosedPhoto]
    points: np.ndarray | None = None
    point_colors: np.ndarray | None = None
    transform: np.ndarray = field(default_factory=lambda: np.eye(4))
    skipped: Mapping[str, str] = field(default_factory=dict)
    upright: bool = False
    names: Sequence[str] | None = None


def assemble(posed: PosedPhotos, settings: PhotoSettings, cache_bytes: int) -> Capture:
    """Make a capture of the photos that can be used.

    Photos are read lazily and are display-referred, and ``cache_bytes`` of them are kept. Of several entries
    for one image the first is taken.

    Raises:
        TronError: fewer than two photos can be used; the line says why for the most of them.
    """
    if not posed.photos:
        raise TronError("the file names no photos", posed.source)
    require_decoders(photo.path for photo in posed.photos)
    cache = PhotoCache(cache_bytes)
    skipped = dict(posed.skipped)
    views: dict[str, View] = {}
    splits: dict[str, str | None] = {}
    claimed: set[str | Path] = set()
    lost_maps: list[str] = []
    reduced: list[tuple[tuple[int, int], tuple[int, int]]] = []
    names = posed.names or view_names([photo.name for photo in posed.photos])
    for name, photo in zip(names, posed.photos):
        try:
            if name in claimed or photo.path in claimed:
                raise TronError("named more than once")
            claimed |= {name} if photo.path is None else {name, photo.path}
            views[name] = _view(name, photo, posed.upright, settings, cache, lost_maps, reduced)
            splits[name] = photo.split
        except TronError as error:
            skipped[_free(name, skipped, views)] = error.what + (f": {error.mend}" if error.mend else "")
    _report(posed, skipped, len(views), lost_maps)
    _log_reduced(posed.source, len(views), reduced, settings)
    ordered = tuple(views[name] for name in sorted(views))
    up = (
        estimate_up([view.camera for view in ordered])
        if settings.up is None
        else np.array(settings.up, float)
    )
    return Capture(
        views=ordered,
        test=_held_out(splits, settings.test_every, posed.source),
        points=posed.points,
        point_colors=posed.point_colors,
        up=up / np.linalg.norm(up),
        transform=posed.transform,
        skipped=skipped,
    )


def _view(
    name: str,
    photo: PosedPhoto,
    upright: bool,
    settings: PhotoSettings,
    cache: PhotoCache,
    lost_maps: list[str],
    reduced: list[tuple[tuple[int, int], tuple[int, int]]],
) -> View:
    if photo.refused or photo.lens is None:
        raise TronError(photo.refused or "no camera")
    if photo.path is None:
        raise TronError("image not found")
    world_to_camera = np.linalg.inv(rigid_pose(photo.camera_to_world))
    header = inspect_photo(photo.path)
    width, height = header.size(upright)
    lens = photo.lens(width, height) if callable(photo.lens) else photo.lens
    # Halved sizes are rounded, so shapes may differ by a pixel.
    if abs(width * lens.height - height * lens.width) > max(
        _SHAPE_TOLERANCE * width * lens.height, lens.width, lens.height
    ):
        raise TronError(
            f"image has {width} x {height} pixels, its intrinsics are for {lens.width:g} x {lens.height:g}"
        )
    size = settings.size_of(width, height)
    camera = lens.camera(world_to_camera, width, height).resized(*size)
    read = partial(PhotoReader, lens=lens, size=size, cache=cache, upright=upright)
    photo_reader = read(photo.path, header)
    maps = {}
    for field_name, (path, decode) in photo.maps.items():
        try:
            maps[field_name] = partial(_map_reader(read, path, header).decoded, decode)
        except TronError as error:
            lost_maps.append(f"{field_name} of {name} ({error.what})")
    if header.alpha:
        maps["mask"] = photo_reader.alpha
    if size != (width, height):
        reduced.append(((width, height), size))
    return View(name, camera, photo_reader.color, "display", **maps)


def _map_reader(read: Callable[..., PhotoReader], path: Path, photo: PhotoHeader) -> PhotoReader:
    header = inspect_photo(path)
    if (header.width, header.height) != (photo.width, photo.height):
        raise TronError(
            f"{header.width} x {header.height} pixels, the photo has {photo.width} x {photo.height}"
        )
    return read(path, header)


def rigid_pose(matrix: object) -> np.ndarray:
    """(4, 4) float64 rigid transform from a (4, 4) or (3, 4) matrix as files have it.

    A uniform scale of the axes is divided out, the position kept; rounding is removed by taking the nearest
    rotation.

    Raises:
        TronError: another shape, NaN, a mirrored, sheared or unevenly scaled matrix.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TronError("pose is not a matrix of numbers") from error
    if pose.shape not in ((4, 4), (3, 4)):
        raise TronError(f"pose has shape {pose.shape}, not (4, 4)")
    if not np.isfinite(pose).all():
        raise TronError("pose holds NaN or infinity")
    if pose.shape == (4, 4) and not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-6):
        raise TronError("last row of the pose is not 0 0 0 1")
    u, scales, vt = np.linalg.svd(pose[:3, :3])
    if scales[0] < 1e-9 or scales[0] - scales[2] > 0.01 * scales[0]:
        raise TronError("pose is no rotation: its axes are not at right angles and of one length")
    if np.linalg.det(pose[:3, :3]) < 0:
        raise TronError("pose is mirrored: its axes are left-handed")
    rigid = np.eye(4)
    rigid[:3, :3] = u @ vt
    rigid[:3, 3] = pose[:3, 3]
    return rigid


def _held_out(splits: Mapping[str, str | None], test_every: int, source: Path) -> frozenset[str]:
    if "test" in splits.values():
        test = frozenset(name for name, split in splits.items() if split == "test")
    else:
        test = frozenset(sorted(splits)[::test_every] if test_every else ())
    if len(test) == len(splits):
        raise TronError(
            f"all {len(splits)} usable views are held out", source, "leave some to train on (test_every)"
        )
    return test


def _free(name: str, *taken: Mapping[str, object]) -> str:
    candidate, count = name, 1
    while any(candidate in each for each in taken):
        count += 1
        candidate = f"{name} ({count})"
    return candidate


def _report(posed: PosedPhotos, skipped: Mapping[str, str], usable: int, lost_maps: list[str]) -> None:
    if usable < 2:
        reasons = Counter(skipped.values())
        why = ", ".join(f"{reason} ({count})" for reason, count in reasons.most_common(3))
        raise TronError(
            f"{usable} of {usable + len(skipped)} photos can be used, at least 2 are needed"
            + (f"; {why}" if why else ""),
            posed.source,
        )
    if skipped:
        shown = ", ".join(f"{name} ({reason})" for name, reason in list(skipped.items())[:_SHOWN])
        rest = f" and {len(skipped) - _SHOWN} more" if len(skipped) > _SHOWN else ""
        total = usable + len(skipped)
        log.warning("%s: %d of %d photos skipped: %s%s", posed.source, len(skipped), total, shown, rest)
    if lost_maps:
        log.warning("%s: %d maps left out, first %s", posed.source, len(lost_maps), lost_maps[0])


def _log_reduced(
    source: Path, count: int, reduced: list[tuple[tuple[int, int], tuple[int, int]]], settings: PhotoSettings
) -> None:
    """Say what ``max_side`` cost; ``downscale`` is asked for, so that it needs no line."""
    if settings.max_side is None or settings.downscale is not None or not reduced:
        return
    (width, height), (small_width, small_height) = max(reduced)
    log.warning(
        "%s: max_side=%d reduces %d of %d photos, %d x %d to %d x %d; max_side=null keeps their size",
        source, settings.max_side, len(reduced), count, width, height, small_width, small_height,
    )  # fmt: skip
