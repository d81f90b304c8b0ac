"""Colours of surfels in the photos, their robust means, and the exposure of each photo.

In the logarithm a photo's exposure and white balance add three numbers to all it shows:

    log c_iv = log C_i + log g_v + noise,        sum_v log g_v = 0

C and g are medians in turn: a highlight, a bystander or a silhouette is in few of a surfel's photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import KDTree

from tron.captures import View
from tron.captures.view import CLIPPED, FLOOR, ToneCurve, linear_light
from tron.reconstruction.geometry.seen_space import OPAQUE
from tron.reconstruction.light.fit_environment import reduced
from tron.reconstruction.progress import Track, untracked
from tron.shading.guidance import ViewTracer

_ROUNDS = 6
_TRUSTED = 20.0  # observations that a photo's exposure needs to be half believed
_REGION = 24  # surfels whose median spread tells a mirror from a wrong depth here and there
_CHANGES = 0.3  # spread from which it does: a factor of 1.35
_FACING = 0.2  # least n.v: flatter views show too few pixels of a surfel
_NEAR = 1.5  # surfel spacings between a centre and the surface in front of the camera
_STEP = 2.0  # spacings along the normal that the surface may lie farther or nearer in the next pixel


@dataclass(frozen=True)
class SurfelColors:
    """Surfel colours that the photos agree on.

    Attributes:
        color: (M, 3) float32 linear colour of each surfel at the mean photo's exposure: a median over its
            photos; 0 if none shows it.
        spread: (M,) float32, median absolute difference of the logarithms from that median.
        count: (M,) int32, photos that show it.
        gain: (V, 3) float32, exposure and white balance of the photos; their mean logarithm is 0.
    """

    color: np.ndarray
    spread: np.ndarray
    count: np.ndarray
    gain: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(M,) bool: surfels that a photo shows."""
        return self.count > 0

    def mirroring(self, means: np.ndarray) -> float:
        """Share of the seen surfels at ``means`` (M, 3) whose neighbourhood changes colour with the view.

        Mirrors, glass, polished metal and black gloss do; neither their shape nor their materials can be
        found. Path-traced balls of these under three maps have 0.2 to 0.75, matt ones and gloss over paint 0.
        """
        seen = np.flatnonzero(self.seen)
        if not len(seen):
            return 0.0
        near = KDTree(means[seen]).query(means[seen], k=min(_REGION, len(seen)))[1]
        return float((np.median(self.spread[seen][near].reshape(len(seen), -1), axis=1) > _CHANGES).mean())


def mean_colors(found: Observations, same_exposure: bool = False) -> SurfelColors:
    """Means of observations; ``same_exposure`` takes all photos as exposed alike."""
    log = np.log(np.maximum(found.color, FLOOR)).astype(np.float64)
    gain = np.zeros((found.views, 3))
    color = np.zeros((found.surfels, 3))
    by_view = np.argsort(found.view, kind="stable")
    shows = np.bincount(found.view, minlength=found.views)
    usable = ~found.clipped[by_view]
    for _ in range(1 if same_exposure else _ROUNDS):
        color = grouped_median(log - gain[found.view], found.surfel, found.surfels)
        if same_exposure:
            break
        off = (log - color[found.surfel])[by_view][usable]
        gain = grouped_median(off, found.view[by_view][usable], found.views)
        gain *= (shows / (shows + _TRUSTED))[:, None]
        gain -= gain[shows > 0].mean(0) if (shows > 0).any() else 0
    count = np.bincount(found.surfel, minlength=found.surfels)
    off = np.abs(log - gain[found.view] - color[found.surfel]).mean(1)
    spread = grouped_median(off[:, None], found.surfel, found.surfels)[:, 0]
    seen = (count > 0)[:, None]
    return SurfelColors(
        np.where(seen, np.exp(color), 0).astype(np.float32),
        spread.astype(np.float32),
        count.astype(np.int32),
        np.exp(gain).astype(np.float32),
    )


def grouped_median(values: np.ndarray, group: np.ndarray, groups: int) -> np.ndarray:
    """(groups, C) medians of values (N, C) by group (N,) int, which does not fall; 0 of an empty group."""
    count = np.bincount(group, minlength=groups)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    filled = count > 0
    low, high = (first + (count - 1) // 2)[filled], (first + count // 2)[filled]
    found = np.zeros((groups, values.shape[1]))
    for channel in range(values.shape[1]):
        column = values[np.lexsort((values[:, channel], group)), channel]
        found[filled, channel] = 0.5 * (column[low] + column[high])
    return found


@dataclass(frozen=True)
class Observations:
    """N colours of M surfels in V photos, ordered by surfel.

    Attributes:
        surfel: (N,) int32.
        view: (N,) int32.
        color: (N, 3) float32 linear light, not negative.
        to_camera: (N, 3) float32 unit, world.
        clipped: (N,) bool, where a channel is as bright as the photo can show.
        surfels: M.
        views: V.
    """

    surfel: np.ndarray
    view: np.ndarray
    color: np.ndarray
    to_camera: np.ndarray
    clipped: np.ndarray
    surfels: int
    views: int

    def __len__(self) -> int:
        return len(self.surfel)

    def taken(self, which: np.ndarray) -> Observations:
        """Some of them: indices in order, or bool (N,)."""
        names = ("surfel", "view", "color", "to_camera", "clipped")
        return replace(self, **{name: getattr(self, name)[which] for name in names})


def observe(
    tracer: ViewTracer, views: Sequence[View], exposure: float, curve: ToneCurve, track: Track = untracked
) -> Observations:
    """Colours of the tracer's surfels in the photos.

    A surfel counts as seen where it faces the camera, lies on the surface that the surfels show there (median
    depth) and is away from silhouettes, whose pixels mix surfaces. Its colour is bilinear in the photo,
    reduced so that a pixel is no smaller than the surfels are apart.

    Args:
        tracer: the surfels.
        views: photos; where they have masks, only the subject counts.
        exposure: of linear images.
        curve: of display images.
        track: wraps the loop over the views.
    """
    scene, parts = tracer.scene, []
    normals, spacing = scene.normals(), scene.spacing
    for number, view in enumerate(track(views, "photos on surfels")):
        camera, seen = view.camera, tracer.gbuffer(view.camera).numpy()
        offset = camera.position - scene.means
        distance = np.linalg.norm(offset, axis=1)
        to_camera = offset / np.maximum(distance, 1e-12)[:, None]
        facing = np.einsum("mi,mi->m", to_camera, normals)
        pixel, depth = camera.project(scene.means)
        ahead = (facing > _FACING) & (depth > 0)
        inside = ahead & (pixel > 1).all(1) & (pixel < (camera.width - 1, camera.height - 1)).all(1)
        index = np.flatnonzero(inside)
        if not len(index):
            continue
        solid = seen["opacity"] > OPAQUE
        if view.has("mask"):
            solid &= view.read("mask") > OPAQUE
        solid &= view.believed()
        far = np.where(solid, seen["depth"], np.inf)
        near = np.where(solid, seen["depth"], 0.0)
        column, row = np.floor(pixel[index]).astype(int).T
        off = np.abs(far[row, column] - distance[index])
        kept = off < _NEAR * spacing / np.maximum(facing[index], 0.5)
        # Of the pixel and its neighbours: beside a silhouette one of them is nearer, farther or empty.
        behind, before = maximum_filter(far, 3)[row, column], minimum_filter(near, 3)[row, column]
        reach = _STEP * spacing / facing[index]
        kept &= (behind - distance[index] < reach) & (distance[index] - before < reach)
        index = index[kept]
        factor = max(1, int(np.median(spacing * camera.fx / distance[index]))) if len(index) else 1
        color = reduced(linear_light(view, exposure, curve), factor)
        shown = reduced(view.read().max(-1), factor) if view.space == "display" else np.zeros(color.shape[:2])
        parts.append(
            (
                index,
                np.full(len(index), number),
                bilinear(color, pixel[index] / factor),
                to_camera[index],
                bilinear(shown, pixel[index] / factor) > CLIPPED,
            )
        )
    empty = (np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
    surfel, photo, color, direction, clipped = (np.concatenate(part) for part in zip(empty, *parts))
    order = np.argsort(surfel, kind="stable")
    return Observations(
        surfel[order].astype(np.int32),
        photo[order].astype(np.int32),
        np.maximum(color[order], 0).astype(np.float32),
        direction[order].astype(np.float32),
        clipped[order],
        len(scene),
        len(views),
    )


def bilinear(image: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(N[, C]) of an image (H, W[, C]) at places (N, 2), x and y in pixels, whose centres are at halves."""
    height, width = image.shape[:2]
    x, y = np.clip(place[:, 0] - 0.5, 0, width - 1), np.clip(place[:, 1] - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(int), max(width - 2, 0)), np.minimum(y.astype(int), max(height - 2, 0))
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = x - left, y - top
    if image.ndim == 3:
        fx, fy = fx[:, None], fy[:, None]
    upper = (1 - fx) * image[top, left] + fx * image[top, right]
    return (1 - fy) * upper + fy * ((1 - fx) * image[below, left] + fx * image[below, right])
