"""The part of space that several pictures show, which is where surfaces can be found at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tron.cameras import focus_of
from tron.captures import Capture, View
from tron.errors import TronError
from tron.seeds import generator

OPAQUE = 0.5
"""Less opaque pixels have no median depth, hence no surface point (conventions.md, 7)."""
_DRAWS = 64
_DRAWS_OF_BOX = 16
_LEAST_SHARE = 0.25
_INSIDE = 0.95
_OUTWARD = 4.0


def random_points(capture: Capture, count: int, seed: int) -> np.ndarray:
    """(count, 3) float32 points, uniform over the part of the cameras' box that the pictures show.

    The box is that of the camera positions, made symmetric about the point that the cameras look at, and a
    few times as large where they look outwards. Points that few cameras see are left out, and so are those
    that the masks show to be empty (the visual hull of Laurentini 1994, with some tolerance). What is left
    may be so small that fewer points are found.
    """
    views = capture.train_views
    focus, outward = focus_of([view.camera.camera_to_world for view in views])
    reach = np.abs(np.stack([view.camera.position for view in views]) - focus).max(axis=0)
    reach = np.maximum(reach, 0.1 * reach.max()) * (_OUTWARD if outward else 1)
    masks = [view.read("mask") > 0.5 if view.has("mask") else None for view in views]
    rng = generator(seed, "reconstruction", "random points")
    centre = focus
    seen, inside, points = [], [], []
    chosen = np.zeros((0, 3))
    for draw in range(_DRAWS):
        if draw >= _DRAWS_OF_BOX and len(chosen) > 1:
            # A small subject in a large box: go on in the box around what was found of it, and some more.
            low, high = chosen.min(axis=0), chosen.max(axis=0)
            centre, reach = (low + high) / 2, np.minimum(0.6 * (high - low), reach)
        batch = centre + rng.uniform(-1, 1, (count, 3)) * reach
        shown, filled = _coverage(batch, views, masks)
        points.append(batch)
        seen.append(shown)
        inside.append(filled)
        most = max(np.max(s) for s in seen)
        kept = [(s >= max(_LEAST_SHARE * most, 1)) & (f >= _INSIDE * s) for s, f in zip(seen, inside)]
        chosen = np.concatenate([p[k] for p, k in zip(points, kept)])[:count]
        if len(chosen) == count:
            break
    if len(chosen) < min(count, 4):
        raise TronError("no part of space is seen by several cameras", mend="check the poses and the masks")
    return chosen.astype(np.float32)


def _coverage(
    points: np.ndarray, views: Sequence[View], masks: Sequence[np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of views, (N,) each, that have a point in their picture, and that have it on the subject."""
    seen, inside = np.zeros(len(points), int), np.zeros(len(points), int)
    for view, mask in zip(views, masks):
        column, row, within = pixels_of(view, points)
        seen += within
        inside += within if mask is None else within & mask[row, column]
    return seen, inside


def pixels_of(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows, (N,) int each, of world points, and whether the picture shows them."""
    camera = view.camera
    pixels, depth = camera.project(points)
    with np.errstate(invalid="ignore"):
        within = (depth > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
        column, row = np.where(within[:, None], pixels, 0).astype(int).T
    return column, row, within
