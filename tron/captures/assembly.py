"""From what a file says of its photos to a capture: what cannot be used is left out, counted and named."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tron.captures.capture import Capture
from tron.captures.image_folder import view_names
from tron.captures.orientation import estimate_up
from tron.captures.photo_files import LINEAR_SUFFIXES, exposure_of, require_decoders
from tron.captures.photo_views import PhotoViews
from tron.captures.photographs import PhotoCache
from tron.captures.posed_photos import PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.captures.view import View
from tron.errors import TronError

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
    require_decoders(photo.path for photo in posed.photos)
    cache = PhotoCache(cache_bytes)
    skipped = dict(posed.skipped)
    views: dict[str, View] = {}
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
            views[name] = made.view(name, photo)
            splits[name] = photo.split
        except TronError as error:
            skipped[_free(name, skipped, views)] = error.what + (f": {error.mend}" if error.mend else "")
    _report(posed, skipped, len(views), made.lost_maps)
    _log_kinds(posed.source, made, sum(path.suffix.lower() in LINEAR_SUFFIXES for path in whole), settings)
    _log_reduced(posed.source, len(views), made.reduced, settings)
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


def _log_kinds(source: Path, made: PhotoViews, linear: int, settings: PhotoSettings) -> None:
    """Say how masks are taken and how linear photos are shown: neither is seen in the files' names."""
    if made.masked:
        meaning = {"ignore": "is not learnt from", "subject": "is empty background"}[str(settings.masks)]
        log.info("%s: what is black in the masks of %d photos %s (masks=ignore, subject or null)",
                 source, made.masked, meaning)  # fmt: skip
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
