"""Geometry of photographs without any prior: plane sweep, fusion, and what all views agree on.

Each photograph's depth comes from its neighbours (:mod:`.sweep`), depths that other photographs do not
confirm are dropped, the rest is fused (:mod:`.fusion`), and each view takes its depth and normals back from
the fused field (:mod:`.consensus`). Photos, poses, masks and, where there are any, sparse points are all that
is used.
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
from tron.priors import Track, untracked
from tron.reconstruction.consensus import fused_views
from tron.reconstruction.fusion import DepthMap, empty_rays
from tron.reconstruction.matching import Photograph
from tron.reconstruction.seen_space import random_points
from tron.reconstruction.settings import StereoSettings
from tron.reconstruction.sweep import Swept, confirmed, neighbours, swept

log = logging.getLogger(__name__)

_BOUNDING_POINTS = 4000
_FEWEST_POINTS = 100
_MOST_POINTS = 50_000
_MOST_PIXELS = 1 << 25  # of all photographs together: some 60 bytes each
_MOST_THREADS = 4  # each holds its photograph's costs on all planes some ten times


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
    device: str | torch.device = "cpu",
    track: Track = untracked,
) -> StereoMaps:
    """Depth and normals of the training views, from their photographs alone.

    Args:
        capture: at least two training views, display images.
        settings: of sweep and fusion.
        seed: root of the points that bound the planes where the capture has none.
        device: torch's.
        track: shows progress.

    Raises:
        TronError: no part of space is seen by several cameras.
    """
    views = capture.train_views
    side = most_side(views, settings.most_side)
    photographs = [Photograph.of(view, side, device) for view in views]
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
            photograph.camera, each.depth, torch.where(ok, 1.0, settings.unsure if view.has("mask") else 0.0),
            empty_rays(photograph.subject) if view.has("mask") else None,
        )
        for view, photograph, each, ok in zip(views, photographs, found, known)
    ]  # fmt: skip
    log.info("stereo: %.0f %% of the pixels have a depth that other photos confirm", 100 * confident)
    return StereoMaps(
        tuple(
            _with_maps(view, photograph, depth, normal)
            for view, photograph, (depth, normal) in zip(views, photographs, fused_views(maps, settings))
        ),
        confident,
    )


def most_side(views: Sequence[View], wanted: int) -> int:
    """Longest side that photographs are reduced to: less than wanted where there are very many."""
    longest = [max(view.camera.width, view.camera.height) for view in views]
    pixels = sum(
        view.camera.width * view.camera.height * min(wanted / side, 1) ** 2
        for view, side in zip(views, longest)
    )
    return max(int(min(wanted, max(longest)) * min((_MOST_PIXELS / pixels) ** 0.5, 1)), 1)


def _with_maps(view: View, photograph: Photograph, depth: Tensor, normal: Tensor) -> View:
    return View(
        view.name,
        photograph.camera,
        photograph.image.movedim(0, -1).cpu().numpy().clip(0, 1),
        view.space,
        depth=depth.cpu().numpy(),
        normal=normal.cpu().numpy(),
        mask=photograph.subject.float().cpu().numpy() if view.has("mask") else None,
    )
