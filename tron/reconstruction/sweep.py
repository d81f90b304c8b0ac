"""Plane sweep: a depth for every pixel of every photograph, from the photographs beside it.

From "A space-sweep approach to true multi-image matching" (Collins 1996): planes through space, even in
inverse distance, on each of which every pixel is compared with where the neighbouring photographs see it.
Sparse points, such as structure from motion leaves, bound the planes of each view and favour those they lie
on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tron.reconstruction.matching import (
    Photograph,
    agreed_cost,
    angles_between,
    project,
    refined_minimum,
    sample,
    window_mean,
)
from tron.reconstruction.semi_global import semi_global_cost
from tron.reconstruction.settings import StereoSettings

_OUTLIERS = (0.5, 99.5)
_MARGIN = (0.95, 1.05)
_FEWEST_POINTS = 20
_SHARED = 0.3
_CLOSE = 1.5  # planes that two photographs' depths may lie apart
_CONFIRMED_BY = 2
_SEED = 0.3


@dataclass(frozen=True, eq=False)
class Swept:
    """Depth of one photograph.

    Attributes:
        depth: (H, W) distance along the rays, world units; 0 beside the subject.
        cost: (H, W) matching cost there, in [0, 1].
        textured: (H, W) bool, windows that differ from one grey by more than 8 bits' rounding.
        step: inverse z between two planes.
    """

    depth: Tensor
    cost: Tensor
    textured: Tensor
    step: float


def neighbours(
    photographs: Sequence[Photograph], points: np.ndarray, settings: StereoSettings
) -> list[list[int]]:
    """Photographs to compare each one with: those seen from nearest the wanted angle.

    Args:
        photographs: of one scene.
        points: (N, 3) world, in the part of space where its surfaces are.
        settings: number and angles.
    """
    shown = np.stack([_shown(photograph, points) for photograph in photographs])
    places = np.stack([photograph.camera.position for photograph in photographs])
    chosen = []
    for index, own in enumerate(shown):
        centre = np.median(points[own] if own.any() else points, axis=0)
        towards = places - centre
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        apart = angles_between(towards)[index]
        shared = (shown & own).sum(1) >= _SHARED * max(own.sum(), 1)
        fit = (apart > settings.least_angle) & (apart < settings.most_angle) & shared
        order = [k for k in np.argsort(np.abs(apart - settings.angle), kind="stable") if fit[k]]
        if not order:
            order = [k for k in np.argsort(apart, kind="stable") if k != index]
        chosen.append([int(k) for k in order[: settings.neighbours]])
    return chosen


def swept(
    photographs: Sequence[Photograph],
    beside: Sequence[Sequence[int]],
    index: int,
    points: np.ndarray,
    settings: StereoSettings,
    *,
    seeded: bool,
) -> Swept:
    """Depth of one photograph.

    Args:
        photographs: all of them.
        beside: see :func:`neighbours`.
        index: the photograph.
        points: (N, 3) world, that bound the planes.
        settings: planes, windows, penalties.
        seeded: the points lie on surfaces, so that planes through them are favoured.
    """
    photograph = photographs[index]
    inverse = plane_depths(photograph, points, settings.planes)
    distances = 1 / inverse[:, None, None] / photograph.along
    others = [photographs[k] for k in beside[index]]
    cost = agreed_cost(photograph, others, distances, settings.radius, settings.best)
    cost = window_mean(cost, 1)
    if seeded:
        cost = _favoured(cost, photograph, points, inverse)
    if settings.smooth_large > 0:
        smooth = semi_global_cost(cost, photograph.grey, settings.smooth_small, settings.smooth_large)
    else:
        smooth = cost
    place, _ = refined_minimum(smooth)
    step = float(inverse[1] - inverse[0])
    depth = 1 / (inverse[0] + place * step) / photograph.along
    at = cost.gather(0, place.round().long()[None])[0]
    depth = torch.where(photograph.subject, depth, 0.0)
    return Swept(depth, at, photograph.textured(settings.radius), abs(step))


def plane_depths(photograph: Photograph, points: np.ndarray, planes: int) -> Tensor:
    """(planes,) inverse z, even, between the nearest and the farthest of the points that it shows."""
    shown = points[_shown(photograph, points)]
    shown = shown if len(shown) >= _FEWEST_POINTS else points
    z = photograph.camera.project(shown)[1]
    z = z[z > 0]
    if not len(z):
        z = np.linalg.norm(points - photograph.camera.position, axis=1)
    near, far = np.percentile(z, _OUTLIERS) * _MARGIN
    return torch.linspace(1 / near, 1 / far, planes, device=photograph.image.device)


def confirmed(
    photographs: Sequence[Photograph], beside: Sequence[Sequence[int]], found: Sequence[Swept]
) -> list[Tensor]:
    """(H, W) bool of each photograph: pixels whose depth at least two of its neighbours confirm."""
    return [_confirmed(photographs, beside[k], found, k) for k in range(len(photographs))]


def _confirmed(
    photographs: Sequence[Photograph], beside: Sequence[int], found: Sequence[Swept], index: int
) -> Tensor:
    photograph, own = photographs[index], found[index]
    origin = own.depth.new_tensor(photograph.camera.position)
    points = origin + own.depth[..., None] * photograph.rays
    agree = torch.zeros_like(own.depth)
    for k in beside:
        other = photographs[k]
        pixels, z = project(other.camera, points)
        # Nearest, because a mean over an edge is a depth at which nothing is.
        theirs = sample((found[k].depth * other.along)[None], pixels[None], "nearest")[0, 0]
        known = (theirs > 0) & (z > 0)
        gap = (1 / torch.where(known, z, 1.0) - 1 / torch.where(known, theirs, 1.0)).abs()
        agree += known & (gap < _CLOSE * max(own.step, found[k].step))
    return (agree >= min(_CONFIRMED_BY, len(beside))) & (own.depth > 0)


def _favoured(cost: Tensor, photograph: Photograph, points: np.ndarray, inverse: Tensor) -> Tensor:
    """The cost, less by a little where points that the photograph shows lie on a plane."""
    shown = torch.from_numpy(points[_shown(photograph, points)]).to(cost)
    pixels, z = project(photograph.camera, shown)
    column, row = pixels.long().unbind(-1)
    plane = ((1 / z - inverse[0]) / (inverse[1] - inverse[0])).round().long()
    inside = (plane >= 0) & (plane < len(inverse))
    cost = cost.clone()
    index = (plane[inside], row[inside], column[inside])
    cost[index] = cost[index] - _SEED
    return cost


def _shown(photograph: Photograph, points: np.ndarray) -> np.ndarray:
    """(N,) bool: the points that lie in the picture."""
    camera = photograph.camera
    pixels, z = camera.project(points)
    with np.errstate(invalid="ignore"):
        return (z > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
