"""Clips of a capture under lights that its photos never saw: guidance by surfels, truth by path tracing."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from datagen.dataset.records import Work
from datagen.dataset.spool import Frame
from datagen.settings.command import Settings
from datagen.sources.captured_clips import CapturedSurfels, LitSurfels, in_order, require_size, resized_view
from datagen.sources.captured_folder import RelitTruth, find_relit, find_truth
from datagen.sources.captured_reconstruction import Found
from datagen.sources.reconstructed import at_true_scale
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import read_capture_folder
from tron.errors import TronError
from tron.shading.environments.environment import EnvironmentMap
from tron.shards.schema import TARGET, ClipMeta

log = logging.getLogger(__name__)

MOST_TURNED, MOST_MOVED = 2.0, 0.05
"""Degrees, and share of the photos' distance from their middle, that a named pose may be off the true one."""


def relit_clips(item: Work, settings: Settings, found: Found) -> Iterator[tuple[ClipMeta, Sequence[Frame]]]:
    """Clips of a capture under each light of ``captured.relit``, light by light, a view each.

    The views of pseudo-captures are eight photos apart, so none goes on from another.

    Frames hold the schema's members, all linear: guidance under that light, from the true cameras, and as
    rgb what was path-traced, in front of the light itself. The world is the truth's: pseudo-captures name
    poses with errors that have no common part. With ``captured.truth`` base color has the truth's scale.

    Args:
        item: the capture; its split is that of its clips (``train_relit``).
        settings: the recipe.
        found: its reconstruction.

    Raises:
        TronError: a folder cannot be read, is not linear or without masks, or its views are too small.
    """
    scene, factors = found.scene, None
    if true := find_truth(settings, item.capture):
        scene, factors = at_true_scale(
            scene, ((view.camera, view.read("base_color"), view.read("mask")) for view in true)
        )
    surfels = CapturedSurfels(item, settings, replace(found, scene=scene))
    for truth in find_relit(settings, item.capture):
        log.info("%s (%s): relit by %s", item.name, item.capture, truth.folder.name)
        capture = read_capture_folder(truth.folder)
        views = sorted(capture.views, key=lambda view: in_order(view.name))
        environment = EnvironmentMap.load(truth.environment)
        lit = surfels.under(environment, "relit", truth.number)
        about: dict[str, Any] = {"relit": truth.folder.name}
        for number, view in enumerate(views):
            camera, frame = _frame(view, lit, environment, settings)
            about["photos"] = [view.name]
            if factors is not None:
                about["albedo_scale"] = [round(float(factor), 6) for factor in factors]
            yield lit.meta(truth.family, truth.number, number, [camera], capture.exposure, **about), [frame]


def require_own_truth(item: Work, settings: Settings, photos: Capture) -> None:
    """Require that ``captured.relit`` and ``truth`` are of this capture, and usable.

    Relit views are named after the photos whose places they are seen from, and a pseudo-capture's poses are
    off by little.

    Raises:
        TronError: a folder cannot be read, is not linear or without masks, its views are too small, or seen
            from elsewhere than the photos of their names.
    """
    cameras = {view.name: view.camera for view in photos.views}
    centres = np.array([camera.position for camera in cameras.values()])
    spread = float(np.median(np.linalg.norm(centres - np.median(centres, 0), axis=1)))
    for truth in find_relit(settings, item.capture):
        views = read_capture_folder(truth.folder).views
        _require_truth(views, truth)
        require_size(views, settings.captured.width, settings.captured.height)
        _require_places(views, cameras, spread, truth.folder, settings)
    if true := find_truth(settings, item.capture):
        assert settings.captured.truth is not None
        _require_places(true, cameras, spread, settings.captured.truth / item.capture, settings)


def _require_places(
    views: Sequence[View], cameras: Mapping[str, Camera], spread: float, folder: Path, settings: Settings
) -> None:
    for view in views:
        own = cameras.get(view.name)
        if own is None or not _near(own, view.camera, spread):
            raise TronError(
                f"view {view.name} is not seen from where the photo of that name was taken",
                folder,
                f"give the folder that was made with {settings.captures}",
            )


def _near(one: Camera, other: Camera, spread: float) -> bool:
    turned = np.degrees(np.arccos(np.clip(one.forward @ other.forward, -1, 1)))
    moved = np.linalg.norm(one.position - other.position)
    return bool(turned < MOST_TURNED and moved < MOST_MOVED * spread)


def _require_truth(views: Sequence[View], truth: RelitTruth) -> None:
    for view in views:
        if view.space != "linear" or not view.has("mask"):
            raise TronError(
                f"view {view.name} is not linear radiance with a mask",
                truth.folder,
                "captured.relit takes the folder relit of tron-datagen mode=pseudo_captures",
            )


def _frame(
    view: View, lit: LitSurfels, environment: EnvironmentMap, settings: Settings
) -> tuple[Camera, Frame]:
    """Return camera and members of one view at the frame's size."""
    wanted = settings.captured
    mask = view.read("mask")[..., None]
    behind = environment.lookup(view.camera.rays())
    # Made smaller in front of its background: what a pixel shows is the mean of what it covers.
    camera, (shown, covered) = resized_view(
        view.camera, (view.read() * mask + behind * (1 - mask), mask[..., 0]), wanted.width, wanted.height
    )
    frame = lit.frame(lit.view(camera, view.name), camera)
    return camera, frame | {
        TARGET: np.maximum(shown, 0.0),
        "foreground": (covered > 0.5).astype(np.float32),
    }
