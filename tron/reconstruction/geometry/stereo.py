"""Geometry from photographs without any prior: plane sweep, fusion, and consensus of the views.

Each photograph's depth comes from its neighbours (:func:`swept`), depths that other photographs do not
confirm are dropped, the rest is fused (:mod:`tron.tracing.fusion`), and each view takes its depth and normals
back from the fused field. Only photos, poses, masks and, if available, sparse points are used.

The sweep is from "A space-sweep approach to true multi-image matching" (Collins 1996): planes through space,
even in inverse distance, on each of which every pixel is compared with where the neighbouring photographs see
it. Sparse points, such as structure from motion leaves, bound the planes of each view and favour those they
lie on.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import drjit as dr
import numpy as np
import torch
from torch import Tensor

from tron.captures import Capture, View
from tron.reconstruction.geometry.matching import (
    Photograph,
    agreed_cost,
    angles_between,
    project,
    refined_minimum,
    sample,
    window_mean,
)
from tron.reconstruction.geometry.seen_space import random_points
from tron.reconstruction.progress import Track, untracked
from tron.reconstruction.settings import StereoSettings
from tron.runtime import torch_device
from tron.tracing.fusion import DepthMap, empty_rays, fused_views

log = logging.getLogger(__name__)

_BOUNDING_POINTS = 4000
_FEWEST_POINTS = 100
_MOST_POINTS = 50_000
_MOST_PIXELS = 1 << 25  # of all photographs together: some 60 bytes each
_MOST_THREADS = 4  # each holds its photograph's costs on all planes some ten times
_SMOOTH_SMALL, _SMOOTH_LARGE = 0.02, 0.2  # prices of one plane's difference to a pixel beside, and of several
_OUTLIERS = (0.5, 99.5)
_MARGIN = (0.95, 1.05)
_FEWEST_SHOWN = 20
_SHARED = 0.3
_CLOSE = 1.5  # planes that two photographs' depths may lie apart
_CONFIRMED_BY = 2
_SEED = 0.3
_SHIFTS = (-1, 0, 1)
_EDGE = 0.1  # difference of grey at which a jump costs 1/e


@dataclass(frozen=True, eq=False)
class StereoMaps:
    """Result of stereo.

    Attributes:
        views: the training views with depth and normals, zero where the views do not agree; large photographs
            reduced.
        confident: share of the subject's pixels whose depth other photographs confirm.
    """

    views: tuple[View, ...]
    confident: float


def stereo_maps(
    capture: Capture,
    settings: StereoSettings,
    seed: int,
    track: Track = untracked,
) -> StereoMaps:
    """Depth and normals of the training views, from their photographs alone.

    Args:
        capture: at least two training views, display images.
        settings: of sweep and fusion.
        seed: root of random points that bound the planes, if the capture has no points.
        track: shows progress.

    Raises:
        TronError: no part of space is seen by several cameras.
    """
    views = capture.train_views
    side = most_side(views, settings.most_side)
    photographs = [Photograph.of(view, side, torch_device()) for view in views]
    seeded = capture.points is not None and len(capture.points) >= _FEWEST_POINTS
    points = capture.points if seeded else random_points(capture, _BOUNDING_POINTS, seed)
    points = np.asarray(points, np.float64)[:: max(len(points) // _MOST_POINTS, 1)]
    beside = neighbours(photographs, points, settings)

    def sweep(index: int) -> Swept:
        return swept(photographs, beside, index, points, settings, seeded=seeded)

    # The cores are the renderer's, which stands still: torch itself runs on one thread each.
    with ThreadPoolExecutor(min(dr.thread_count(), _MOST_THREADS)) as pool:
        found = [each for _, each in zip(track(views, "stereo"), pool.map(sweep, range(len(views))))]
    known = [
        ok & (each.cost < 1 - settings.confident) & each.textured
        for ok, each in zip(confirmed(photographs, beside, found), found)
    ]
    subject = sum(int(photograph.subject.sum()) for photograph in photographs)
    confident = sum(int(each.sum()) for each in known) / max(subject, 1)
    maps = [
        DepthMap(
            photograph.camera,
            each.depth.cpu().numpy(),
            np.where(ok.cpu().numpy(), 1.0, settings.unsure if view.has("mask") else 0.0),
            empty_rays(photograph.subject.cpu().numpy()) if view.has("mask") else None,
        )
        for view, photograph, each, ok in zip(views, photographs, found, known)
    ]  # fmt: skip
    log.info("stereo: %.0f %% of the pixels have a depth that other photos confirm", 100 * confident)
    agreed = fused_views(maps, settings.truncation, settings.sigma, settings.most_voxels)
    every = zip(views, photographs, agreed)
    return StereoMaps(tuple(_with_maps(view, shown, *found) for view, shown, found in every), confident)


def most_side(views: Sequence[View], wanted: int) -> int:
    """Longest side that photographs are reduced to; below the wanted one if there are very many."""
    longest = [max(view.camera.width, view.camera.height) for view in views]
    pixels = sum(
        view.camera.width * view.camera.height * min(wanted / side, 1) ** 2
        for view, side in zip(views, longest)
    )
    return max(int(min(wanted, max(longest)) * min((_MOST_PIXELS / pixels) ** 0.5, 1)), 1)


def _with_maps(view: View, photograph: Photograph, depth: np.ndarray, normal: np.ndarray) -> View:
    return View(
        view.name,
        photograph.camera,
        photograph.image.movedim(0, -1).cpu().numpy().clip(0, 1),
        view.space,
        depth=depth,
        normal=normal,
        mask=photograph.subject.float().cpu().numpy() if view.has("mask") else None,
    )


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
    smooth = semi_global_cost(cost, photograph.grey, _SMOOTH_SMALL, _SMOOTH_LARGE)
    place, _ = refined_minimum(smooth)
    step = float(inverse[1] - inverse[0])
    depth = 1 / (inverse[0] + place * step) / photograph.along
    at = cost.gather(0, place.round().long()[None])[0]
    depth = torch.where(photograph.subject, depth, 0.0)
    return Swept(depth, at, photograph.textured(settings.radius), abs(step))


def plane_depths(photograph: Photograph, points: np.ndarray, planes: int) -> Tensor:
    """(planes,) inverse z, even, between the nearest and the farthest of the points that it shows."""
    shown = points[_shown(photograph, points)]
    shown = shown if len(shown) >= _FEWEST_SHOWN else points
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
        # Nearest, because a mean over an edge lies on no surface.
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


def semi_global_cost(cost: Tensor, grey: Tensor, small: float, large: float) -> Tensor:
    """Mean of the directions' path costs, (K, H, W).

    From "Stereo Processing by Semiglobal Matching and Mutual Information" (Hirschmueller 2008), eq. 13. Along
    each of eight directions through the image, with q the pixel before p,

        L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + P1, min_i L(q, i) + P2) - min_i L(q, i)

    and the sum over the directions is what a pixel is decided by. A small step of depth costs P1, any other
    P2, less where the picture has an edge.

    Args:
        cost: (K, H, W) of hypotheses that are ordered, as planes of a sweep are.
        grey: (H, W) the picture, display values.
        small, large: P1 and P2.
    """
    total = torch.zeros_like(cost)
    for flipped in (False, True):  # left to right and back
        for transposed in (False, True):  # down, and along the rows
            volume, picture = cost.movedim(1, 2) if transposed else cost, grey.T if transposed else grey
            if flipped:
                volume, picture = volume.flip(1), picture.flip(0)
            # Diagonals belong to two sweeps: they are taken going down and up.
            paths = _sweep(volume, picture, small, large, (0,) if transposed else _SHIFTS)
            if flipped:
                paths = paths.flip(1)
            total += paths.movedim(1, 2) if transposed else paths
    return total / 8


def _sweep(cost: Tensor, grey: Tensor, small: float, large: float, shifts: tuple[int, ...]) -> Tensor:
    """Sum over the shifts of the path costs down the rows, each row from the last one moved by the shift."""
    rows = torch.empty_like(cost)
    last = torch.stack([cost[:, 0]] * len(shifts))  # (S, K, W)
    rows[:, 0] = last.sum(0)
    for row in range(1, cost.shape[1]):
        before = torch.stack([_moved(paths, shift) for paths, shift in zip(last, shifts)])
        edge = torch.stack([(grey[row] - _moved(grey[row - 1], shift)).abs() for shift in shifts])
        jump = (large * torch.exp(-edge / _EDGE)).clamp(min=small)[:, None]
        least = before.amin(1, keepdim=True)
        step = before.clone()
        step[:, 1:] = torch.minimum(step[:, 1:], before[:, :-1] + small)
        step[:, :-1] = torch.minimum(step[:, :-1], before[:, 1:] + small)
        last = cost[:, row] + torch.minimum(step, least + jump) - least
        rows[:, row] = last.sum(0)
    return rows


def _moved(values: Tensor, shift: int) -> Tensor:
    """Values (..., W) moved to the right by ``shift``; at the border the nearest."""
    if shift == 0:
        return values
    if shift > 0:
        return torch.cat([values[..., :1], values[..., :-1]], -1)
    return torch.cat([values[..., 1:], values[..., -1:]], -1)
