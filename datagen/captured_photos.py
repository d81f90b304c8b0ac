"""Photos of a capture as the truth of training pairs: in rows of neighbours, balanced, of a frame's size."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.photo_files import SUFFIXES
from tron.captures.view import ToneCurve
from tron.errors import TronError
from tron.priors.linear_light import decoded, encoded

Box = tuple[float, float, float, float]
"""Left, top, right and bottom, pixels."""


@dataclass(frozen=True)
class Photo:
    """A photo as a frame shows it.

    Attributes:
        camera: of the frame.
        shown: (H, W, 3) float32 display values; black where the subject's mask is 0.
        foreground: (H, W) bool, on the subject, where the capture says so; None where it does not.
        believed: (H, W) bool, pixels that are not a passer-by's.
    """

    camera: Camera
    shown: np.ndarray
    foreground: np.ndarray | None
    believed: np.ndarray


def rows_of_photos(capture: Capture) -> list[list[View]]:
    """Training views in rows without a gap, in the order of their names, numbers in them as numbers.

    A photo that was skipped or held out ends a row.
    """
    learnt = {view.name: view for view in capture.train_views}
    lost = {
        _without_suffix(name) for name, why in capture.skipped.items() if not why.startswith("named more")
    }
    rows: list[list[View]] = [[]]
    for name in sorted({*learnt, *capture.test, *lost}, key=in_order):
        if name in learnt:
            rows[-1].append(learnt[name])
        elif rows[-1]:
            rows.append([])
    return [row for row in rows if row]


def in_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """Key that sorts names as people number them: img_9 before img_10."""
    parts = [part for part in re.split(r"([0-9]+)", name) if part]
    return tuple((0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts)


def starts(count: int, frames: int) -> list[int]:
    """First photos of the clips of a row of ``count``; the last clip ends with the row, and may overlap.

    >>> starts(12, 5), starts(4, 5)
    ([0, 5, 7], [])
    """
    if count < frames:
        return []
    found = list(range(0, count - frames + 1, frames))
    return found if found[-1] + frames == count else [*found, count - frames]


def frame_of(view: View, gain: np.ndarray, curve: ToneCurve, width: int, height: int) -> Photo:
    """A photo in a frame's pixels.

    It is made smaller, by Pillow's Hamming filter in display space, until it just covers the frame, and what
    stands over at two edges is cut off.

    Args:
        view: the photo, display values.
        gain: (3,) its exposure and white balance over those of the mean photo, linear; it is shown without.
        curve: that its display values went through.
        width, height: of the frame, pixels.

    Raises:
        TronError: the photo is smaller than the frame, or cannot be read.
    """
    box = _covered(view.camera, width, height, view.name)
    mask = view.read("mask") if view.has("mask") and not view.has("sky_mask") else None
    shown = balanced(view.read(), gain, curve, mask)
    if view.has("mask"):
        foreground = _resized(view.read("mask"), box, width, height) > 0.5
    else:
        foreground = None
    believed = _resized(view.believed().astype(np.float32), box, width, height) > 0.99
    shown = np.clip(_resized(shown, box, width, height), 0.0, 1.0)
    return Photo(_cut(view.camera, box, width, height), shown, foreground, believed)


def resized_view(
    camera: Camera, images: Sequence[np.ndarray], width: int, height: int
) -> tuple[Camera, list[np.ndarray]]:
    """A camera and its images (H, W) or (H, W, C) in a frame's pixels, as :func:`frame_of` makes them.

    Raises:
        TronError: they are smaller than the frame.
    """
    box = _covered(camera, width, height)
    return _cut(camera, box, width, height), [_resized(image, box, width, height) for image in images]


def balanced(
    display: np.ndarray, gain: np.ndarray, curve: ToneCurve, mask: np.ndarray | None = None
) -> np.ndarray:
    """(H, W, 3) display values of a photo without its gain, in front of black where it has a mask (H, W).

    Both are done in linear light. A gain of one changes no bit.
    """
    linear = np.asarray(decoded(display, curve), np.float32)
    moved = encoded((linear / gain).astype(np.float32), curve) - encoded(linear, curve)
    shown = np.clip(display + moved, 0.0, 1.0)
    if mask is not None and (mask < 1).any():
        over = encoded(np.asarray(decoded(shown, curve), np.float32) * mask[..., None], curve)
        shown = np.where(mask[..., None] < 1, over, shown)
    return np.asarray(shown, np.float32)


def require_size(views: Iterable[View], width: int, height: int) -> None:
    """Raise TronError, naming the first photo, where one is smaller than a frame."""
    for view in views:
        _covered(view.camera, width, height, view.name)


def _covered(camera: Camera, width: int, height: int, name: str = "") -> Box:
    """Left, top, right and bottom of what a frame shows of a photo, pixels of the photo."""
    shrink = min(camera.width / width, camera.height / height)
    if shrink < 1:
        raise TronError(
            f"a photo has {camera.width} x {camera.height} pixels, fewer than a frame, {width} x {height}",
            f"view {name}" if name else None,
            "make captured.width and captured.height smaller",
        )
    left, top = (camera.width - shrink * width) / 2, (camera.height - shrink * height) / 2
    if shrink == 1:  # whole pixels, which nothing blurs
        left, top = float(int(left)), float(int(top))
    return left, top, left + shrink * width, top + shrink * height


def _cut(camera: Camera, box: Box, width: int, height: int) -> Camera:
    left, top, right, _ = box
    scale = width / (right - left)
    return replace(
        camera,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=(camera.cx - left) * scale,
        cy=(camera.cy - top) * scale,
        width=width,
        height=height,
    )


def _resized(image: np.ndarray, box: Box, width: int, height: int) -> np.ndarray:
    channels = np.atleast_3d(np.asarray(image, np.float32))
    made = [
        Image.fromarray(np.ascontiguousarray(channels[..., k])).resize(
            (width, height), Image.Resampling.HAMMING, box=box
        )
        for k in range(channels.shape[2])
    ]
    return np.stack([np.asarray(each, np.float32) for each in made], -1).reshape(
        (height, width, *np.shape(image)[2:])
    )


def _without_suffix(name: str) -> str:
    stem, dot, suffix = name.rpartition(".")
    return stem if dot and stem and f".{suffix.lower()}" in SUFFIXES else name
