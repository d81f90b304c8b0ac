"""The first surfels of a capture: from its points, from depth maps, or from nothing but the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.special import logit

from tron.cameras import focus_of
from tron.captures import Capture, View
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.gaussians.harmonics import SH_COUNT, rgb_to_dc
from tron.gaussians.scene import (
    GaussianScene,
    measure_spacing,
    neighbour_distances,
    quats_from_normals,
)
from tron.reconstruction.settings import InitialSettings
from tron.seeds import generator

Source = Literal["points", "depth", "random"]

_EXTENT_MARGIN = 1.1
_SAME_PLACE = 1e-9  # rounding moves cameras that turn on the spot by about 1e-16
_DRAWS = 64
_DRAWS_OF_BOX = 16
_LEAST_SHARE = 0.25
_INSIDE = 0.95
_OUTWARD = 4.0
_ABOUT = 0.99  # surfels from depth maps are as many as asked for within half a percent


def extent_of(views: Sequence[View]) -> float:
    """Size of a capture, world units: 1.1 x the median distance of the cameras to their median centre."""
    positions = np.stack([view.camera.position for view in views])
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    extent = float(_EXTENT_MARGIN * np.median(distance))
    if not extent > _SAME_PLACE * np.abs(positions).max():
        raise TronError("all cameras of the capture stand at one place", mend="photograph it from around it")
    return extent


def source_of(capture: Capture, settings: InitialSettings) -> Source:
    """Source of a capture's first surfels.

    Raises:
        TronError: the source asked for is not there.
    """
    has_depth = any(view.has("depth") for view in capture.train_views)
    if settings.source == "auto":
        return "points" if capture.points is not None else "depth" if has_depth else "random"
    if settings.source == "points" and capture.points is None:
        raise TronError("the capture has no points", mend="start from depth maps or random points")
    if settings.source == "depth" and not has_depth:
        raise TronError("no training view has a depth map", mend="start from points or random points")
    return settings.source


def initial_surfels(
    capture: Capture, settings: InitialSettings, seed: int, most: int | None = None
) -> GaussianScene:
    """Surfels to begin with.

    Args:
        capture: its training views and points.
        settings: source, number and kernel.
        seed: root of all random numbers.
        most: maximum number of surfels; of more points as many are drawn.

    Raises:
        TronError: the source asked for is not there.
    """
    source = source_of(capture, settings)
    if source == "points" and capture.points is not None:
        points, colors = capture.points, capture.point_colors
        if most is not None and len(points) > most:
            draw = generator(seed, "reconstruction", "points")
            chosen = np.sort(draw.choice(len(points), most, replace=False))
            points, colors = points[chosen], None if colors is None else colors[chosen]
        return surfels_at(points, colors, capture, settings, seed)
    if source == "depth":
        from tron.reconstruction.depth_maps import surfels_from_depth

        if most is not None and settings.count > _ABOUT * most:
            settings = settings.model_copy(update={"count": int(_ABOUT * most)})
        return surfels_from_depth(capture, settings, seed)
    points = random_points(capture, min(settings.count, most or settings.count), seed)
    return surfels_at(points, None, capture, settings, seed)


def surfels_at(
    points: np.ndarray, colors: np.ndarray | None, capture: Capture, settings: InitialSettings, seed: int
) -> GaussianScene:
    """A round surfel at each point, as wide as the root mean square distance to its three neighbours.

    A surfel has one visible side. Nothing is known of the surface, so each faces a camera drawn at random
    from those that have it in their picture: neighbours then face all sides that anyone sees.

    Args:
        points: (N, 3) world.
        colors: (N, 3) display, or None for grey.
        capture: its training views.
        settings: opacity and kernel.
        seed: root of the draw.
    """
    count = len(points)
    if count < 4:
        raise TronError(f"{count} points are too few to begin with", mend="give more, or random points")
    distances = neighbour_distances(points)
    smallest = np.median(distances) * 1e-3 + 1e-7
    base = np.full((count, 3), 0.5) if colors is None else np.asarray(colors, np.float64)
    sh = np.zeros((count, SH_COUNT, 3))
    sh[:, 0] = rgb_to_dc(base)
    return GaussianScene(
        means=points,
        quats=quats_from_normals(_towards_cameras(points, capture.train_views, seed)),
        log_scales=np.log(np.maximum(distances, smallest))[:, None].repeat(2, axis=1),
        opacity_logits=np.full(count, logit(settings.opacity)),
        sh=sh,
        base_color=srgb_to_linear(base),
        roughness=np.full(count, 0.5),
        metallic=np.zeros(count),
        object_id=np.zeros(count, np.int32),
        kernel_degree=settings.kernel_degree,
        spacing=measure_spacing(points),
        up=capture.up,
    )


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
        column, row, within = _pixels(view, points)
        seen += within
        inside += within if mask is None else within & mask[row, column]
    return seen, inside


def _pixels(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows, (N,) int each, of world points, and whether the picture shows them."""
    camera = view.camera
    pixels, depth = camera.project(points)
    with np.errstate(invalid="ignore"):
        within = (depth > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
        column, row = np.where(within[:, None], pixels, 0).astype(int).T
    return column, row, within


def _towards_cameras(points: np.ndarray, views: Sequence[View], seed: int) -> np.ndarray:
    """(N, 3) unit directions to a camera that has the point in its picture, drawn at random."""
    rng = generator(seed, "reconstruction", "facing")
    best = np.full(len(points), -1.0)
    chosen = np.zeros(len(points), int)
    for index, view in enumerate(views):
        within = _pixels(view, points)[2]
        lot = np.where(within, 1.0, 0.0) + 0.5 * rng.random(len(points))
        chosen = np.where(lot > best, index, chosen)
        best = np.maximum(lot, best)
    positions = np.stack([view.camera.position for view in views])
    direction = positions[chosen] - points
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return np.where(length > 0, direction / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))
