"""Clips of a capture under lights that its photos never saw: guidance of its surfels, path-traced truth."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import numpy as np

from datagen.captured_photos import in_order, require_size, resized_view, starts
from datagen.captured_relit import RelitTruth, find_relit
from datagen.captured_surfels import CapturedSurfels, LitSurfels, stored_guidance
from datagen.lights import classify, contrast_share
from datagen.plan import Work
from datagen.settings import Settings
from datagen.spool import Frame
from tron.cameras import Camera
from tron.captures import View
from tron.captures.folder import read_capture_folder
from tron.errors import TronError
from tron.shading.environment import EnvironmentMap
from tron.shards.schema import MEMBERS, TARGET, ClipMeta, clip_members

log = logging.getLogger(__name__)


def relit_clips(
    item: Work, settings: Settings, surfels: CapturedSurfels
) -> Iterator[tuple[ClipMeta, Sequence[Frame]]]:
    """Clips of a capture under each light of ``captured.relit``, light by light.

    Frames hold the schema's members, all linear: guidance under that light, from the true cameras, and as
    rgb what was path-traced, in front of the light itself. The world is the truth's: pseudo-captures name
    poses with errors that have no common part.

    Args:
        item: the capture; its split is that of its clips (``train_relit``).
        settings: the recipe.
        surfels: its reconstruction.

    Raises:
        TronError: a folder cannot be read, is not linear or without masks, or its views are too small.
    """
    for truth in find_relit(settings, item.capture):
        log.info("%s (%s): relit by %s", item.name, item.capture, truth.folder.name)
        capture = read_capture_folder(truth.folder)
        views = sorted(capture.views, key=lambda view: in_order(view.name))
        _require_truth(views, truth)
        require_size(views, settings.captured.width, settings.captured.height)
        environment = EnvironmentMap.load(truth.environment)
        lit = surfels.under(environment, "relit", truth.number)
        for number, start in enumerate(starts(len(views), settings.captured.relit_frames)):
            chosen = views[start : start + settings.captured.relit_frames]
            made = [_frame(view, lit, environment, settings) for view in chosen]
            cameras = [camera for camera, _ in made]
            meta = _meta(item, settings, truth, environment, capture.exposure, number, chosen, cameras)
            yield meta, [frame for _, frame in made]


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
    """One view at the frame's size: its camera and members."""
    wanted = settings.captured
    mask = view.read("mask")[..., None]
    behind = environment.lookup(view.camera.rays())
    # Made smaller in front of its background: what a pixel shows is the mean of what it covers.
    camera, (shown, covered) = resized_view(
        view.camera, (view.read() * mask + behind * (1 - mask), mask[..., 0]), wanted.width, wanted.height
    )
    frame = stored_guidance(lit.view(camera, view.name))
    return camera, frame | {
        TARGET: np.maximum(shown, 0.0),
        "foreground": (covered > 0.5).astype(np.float32),
    }


def _meta(
    item: Work,
    settings: Settings,
    truth: RelitTruth,
    environment: EnvironmentMap,
    exposure: float,
    number: int,
    views: Sequence[View],
    cameras: Sequence[Camera],
) -> ClipMeta:
    wanted = settings.captured
    return ClipMeta(
        key=f"{item.name}-l{truth.number}-c{number:04d}",
        scene=item.name,
        light=f"{item.name}-{truth.family}{truth.number}",
        light_family=truth.family,
        split=item.split,
        frames=len(cameras),
        width=wanted.width,
        height=wanted.height,
        cameras=[camera.to_dict() for camera in cameras],
        exposure=exposure,
        color_space={
            name: space
            for name in clip_members(reference=False)
            if (space := MEMBERS[name].color_space) is not None
        },
        seeds={"root": settings.seed},
        spp={"guidance": wanted.guidance_spp},
        extra={
            "style": "captured",
            "capture": item.capture,
            "contrast": classify(environment),
            "contrast_share": contrast_share(environment),
            "relit": truth.folder.name,
            "photos": [view.name for view in views],
        },
    )
