"""Assemble a capture from a file's photos: unusable ones are left out, counted and named."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tron.cameras import Camera
from tron.captures.capture import Capture
from tron.captures.coverage import HALF, seen_from_deg
from tron.captures.metric import in_metres
from tron.captures.photos.image_folder import view_names
from tron.captures.photos.photo_files import LINEAR_SUFFIXES, exposure_of, require_decoders
from tron.captures.photos.photo_views import PhotoViews
from tron.captures.photos.photographs import PhotoCache, PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.captures.view import View
from tron.errors import TronError
from tron.io.local_frame import local_origin, said

log = logging.getLogger(__name__)

_SHOWN = 5


def assemble(posed: PosedPhotos, settings: PhotoSettings, cache_bytes: int) -> Capture:
    """Make a capture of the photos that can be used.

    Photos are read lazily and are display-referred, and ``cache_bytes`` of them are kept. Of several entries
    for one image the first is taken.

    Raises:
        TronError: fewer than two photos can be used; the line says why for the most of them.
    """
    if not posed.photos:
        raise TronError("the file names no photos", posed.source)
    if settings.scale is not None:
        posed = in_metres(posed, settings.scale)
    posed, offset = about_local_origin(posed)
    require_decoders(photo.path for photo in posed.photos)
    cache = PhotoCache(cache_bytes)
    skipped = dict(posed.skipped)
    views: dict[str, list[View]] = {}  # of each photo; a panorama has several
    splits: dict[str, str | None] = {}
    claimed: set[str | Path] = set()
    whole = [photo.path for photo in posed.photos if photo.path is not None]
    made = PhotoViews(settings, cache, posed.upright, exposure_of(whole, settings.exr_exposure))
    names = posed.names or view_names([photo.name for photo in posed.photos])
    for name, photo in zip(names, posed.photos):
        try:
            if name in claimed or photo.path in claimed:
                raise TronError("named more than once")
            claimed |= {name} if photo.path is None else {name, photo.path}
            views[name] = made.views(name, photo)
            splits[name] = photo.split
        except TronError as error:
            skipped[_free(name, skipped, views)] = error.what + (f": {error.mend}" if error.mend else "")
    _report(posed, skipped, len(views), made.lost_maps)
    _log_kinds(posed.source, made, sum(path.suffix.lower() in LINEAR_SUFFIXES for path in whole), settings)
    ordered = tuple(view for name in sorted(views) for view in views[name])
    _log_reduced(posed.source, len(ordered), made.reduced, settings)
    held_out = _held_out(splits, settings.test_every, posed.source)
    cameras = [view.camera for view in ordered]
    stated = posed.up if settings.up is None else np.array(settings.up, float)
    up = estimate_up(cameras) if stated is None else np.array(stated)
    up /= np.linalg.norm(up)
    around = seen_from_deg(cameras, up)
    if around is not None and around < HALF:
        log.warning(
            "%s: photos show it from %.0f degrees around alone: what faces away stays unknown, casts no "
            "shadow, and light comes in from there",
            posed.source,
            around,
        )
    return Capture(
        views=ordered,
        test=frozenset(view.name for name in held_out for view in views[name]),
        points=posed.points,
        point_colors=posed.point_colors,
        up=up,
        transform=posed.transform,
        skipped=skipped,
        offset=offset,
    )


def _held_out(splits: Mapping[str, str | None], test_every: int, source: Path) -> frozenset[str]:
    """Names of the photos that are held out; all faces of a panorama show one place and stay together."""
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


def _log_kinds(source: Path, made: PhotoViews, linear: int, settings: PhotoSettings) -> None:
    """Say how masks are taken, what colours are in and how linear photos are shown: no name tells."""
    if made.masked:
        meaning = {"ignore": "is not learnt from", "subject": "is empty background"}[str(settings.masks)]
        log.info("%s: what is black in the masks of %d photos %s (masks=ignore, subject or null)",
                 source, made.masked, meaning)  # fmt: skip
    if made.panoramas:
        log.info("%s: %d photos of 360 degrees are cut into six views each", source, made.panoramas)
    for note, count in made.notes.items():
        log.info("%s: of %d photos %s", source, count, note)
    if linear:
        log.info("%s: %d EXR photos are shown with exposure %.4g (exr_exposure) and the sRGB curve",
                 source, linear, made.exposure)  # fmt: skip


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


log = logging.getLogger(__name__)


def about_local_origin(posed: PosedPhotos) -> tuple[PosedPhotos, np.ndarray]:
    """The photos and points without the middle of large coordinates, and the (3,) float64 offset taken away.

    Poses and points are float64 until here. Cameras and points decide together; what is no pose is left to
    those who read it. Captures whose coordinates float32 resolves are given back as they are.
    """
    positions = [_position(photo.camera_to_world) for photo in posed.photos if photo.refused is None]
    places = np.array([each for each in positions if each is not None]).reshape(-1, 3)
    if posed.points is not None:
        places = np.concatenate([places, np.asarray(posed.points, np.float64)])
    offset = local_origin(places[np.isfinite(places).all(1)])
    if not offset.any():
        return posed, offset
    log.info("%s: large coordinates: %s is taken away from them and kept", posed.source, said(offset))
    back = np.eye(4)
    back[:3, 3] = -offset
    photos = [
        replace(photo, camera_to_world=_shifted(photo.camera_to_world, offset)) for photo in posed.photos
    ]
    points = None if posed.points is None else np.asarray(posed.points, np.float64) - offset
    return replace(posed, photos=photos, points=points, transform=back @ posed.transform), offset


def _position(camera_to_world: object) -> np.ndarray | None:
    """(3,) position of a pose as files have it; None where it is no matrix of numbers."""
    try:
        matrix = np.asarray(camera_to_world, np.float64)
    except (TypeError, ValueError):
        return None
    return matrix[:3, 3] if matrix.shape in ((3, 4), (4, 4)) else None


def _shifted(camera_to_world: object, offset: np.ndarray) -> object:
    if _position(camera_to_world) is None:
        return camera_to_world
    matrix = np.array(camera_to_world, np.float64)
    matrix[:3, 3] -= offset
    return matrix


_STEPS = 20
_ROLL = 0.003
_SIDEWAYS = 0.9
_FLAT = 0.1


def estimate_up(cameras: Sequence[Camera]) -> np.ndarray:
    """Estimate the world's up direction, (3,) float64 unit, from cameras that a person held.

    People turn and tilt a camera but seldom roll it: its x axis stays level, and its y axis points up on
    average. Three cases:

    - Cameras' up axes agree on the whole. Up is where the robust (L1) mean of these axes and the level x axes
      meet: it minimises ``sum_i w_i (x_i . u)^2 + r |u - m|^2`` over directions u, with m the mean, r =
      0.003 and weights w that spare rolled cameras. Cameras that all look down on one side of a table pull
      m over, but not x. Where x axes say nothing, since all are parallel, m decides.
    - Up axes cancel while x axes agree: the photos lie on their side, as a phone held upright stores them.
      The x axis is then vertical, with the sign that has the cameras look down on average.
    - Neither: seen from a drone, or rolled at will. If the cameras' positions lie in a plane, up is its
      normal, on the side of the mean up axis or, where that vanishes, against the view; else the mean up
      axis.
    """
    rights = np.stack([camera.camera_to_world[:3, 0] for camera in cameras])
    ups = np.stack([camera.up for camera in cameras])
    backward = -np.mean([camera.forward for camera in cameras], axis=0)
    mean_up, mean_right = _robust_mean(ups), _robust_mean(rights)
    agreement = np.linalg.norm(ups.mean(0))
    if agreement < 0.3 and np.linalg.norm(rights.mean(0)) > _SIDEWAYS:
        return _level(mean_right * _sign(mean_right @ backward), ups)
    if agreement >= 0.3:
        return _level(mean_up, rights)
    positions = np.stack([camera.position for camera in cameras])
    _, spread, axes = np.linalg.svd(positions - positions.mean(0), full_matrices=False)
    if len(spread) == 3 and spread[2] < _FLAT * spread[1]:
        reference = mean_up @ axes[2] if agreement > 0.1 else backward @ axes[2]
        return axes[2] * _sign(reference)
    return mean_up


def _robust_mean(axes: np.ndarray) -> np.ndarray:
    """Unit direction with the least sum of distances to unit axes (N, 3), by reweighting (Weiszfeld)."""
    mean = _unit(axes.mean(0))
    for _ in range(_STEPS):
        weights = 1 / np.maximum(np.linalg.norm(axes - mean, axis=1), 1e-3)
        mean = _unit(weights @ axes)
    return mean


def _level(mean: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Refine an up direction by axes (N, 3) that ought to be level, sparing those that are not."""
    up = mean
    for _ in range(_STEPS):
        weights = 1 / np.maximum(np.abs(level @ up), 0.02)
        weights /= weights.sum()
        scatter = (level * weights[:, None]).T @ level
        up = _unit(np.linalg.solve(scatter + _ROLL * np.eye(3), _ROLL * mean))
    return up


def _unit(vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])


def _sign(value: float) -> float:
    return -1.0 if value < 0 else 1.0
