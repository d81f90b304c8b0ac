"""The network of a run of tron-relight: found, checked against the settings, and loaded before any frame."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tron.apps.relight_settings import Settings
from tron.cli.installation import require_extra
from tron.errors import TronError
from tron.neural.shipped import DEFAULT, checkpoint_file
from tron.neural.windows import check_frames
from tron.runtime import set_torch_threads, torch_device
from tron.storage import sha256

if TYPE_CHECKING:
    from tron.neural.protocols import Renderer

log = logging.getLogger(__name__)


def chosen_network(settings: Settings) -> tuple[Settings, Renderer | None]:
    """The settings as they will be followed, and the network on its device, or None without one.

    A checkpoint that was asked for has to fit. That of checkpoint=auto gives way with a line in the log:
    where the libraries of networks or its file are not installed; where nothing bounces and it is given lit;
    where radiance is asked for, which a network does not draw; and where lit has sub-pixels or rays for
    reflections (quality=final), for it learnt from single samples and makes finer pictures worse
    (docs/experiments.md). Where window, overlap, reproject or weights are chosen, it has to fit too.

    Raises:
        TronError: the checkpoint is missing, damaged, or does not fit the settings.
    """
    if settings.checkpoint is None:
        return settings, None
    if not settings.takes_default:
        return settings, _loaded(settings)
    try:
        if "relit" in settings.buffers:
            raise TronError("buffers ask for relit.exr, and a network draws display values")
        estimation = settings.estimation()
        if estimation.supersample > 1 or estimation.reflections > 0:
            raise TronError(
                f"{DEFAULT} learnt from single samples a pixel, and this picture is better without it",
                mend=f"give checkpoint={DEFAULT} to have it all the same",
            )
        settings = settings.model_copy(update={"checkpoint": Path(DEFAULT)})
        return settings, _loaded(settings)
    except TronError as error:
        if settings.tuned:
            raise
        log.info("No network: %s", error)
        return settings.model_copy(update={"checkpoint": None}), None


def averaged_frames_of(settings: Settings, frames: int) -> int:
    """Frames that each one is the mean of along its motion: 1 where the light turns, or nothing is drawn."""
    turns = len(set(settings.rotations(frames))) > 1
    return 1 if settings.checkpoint is None or turns else min(settings.reproject, frames)


def describe_network(settings: Settings, renderer: Renderer | None, frames: int) -> dict[str, Any] | None:
    """Record of the network for relight.json, None without one; weights null: equal ones."""
    if renderer is None or settings.checkpoint is None:
        return None
    return {
        "checkpoint": str(settings.checkpoint),
        "sha256": sha256(checkpoint_file(settings.checkpoint)),
        "guidance": list(renderer.config.guidance),
        "window": settings.window or renderer.config.window,
        "overlap": settings.overlap,
        "reproject": averaged_frames_of(settings, frames),
        "weights": settings.weights or getattr(renderer.config, "weights", None),
    }


def _loaded(settings: Settings) -> Renderer:
    assert settings.checkpoint is not None
    require_extra("checkpoint", "train")
    from tron.neural.weights import load_renderer

    if settings.threads is not None:
        set_torch_threads(settings.threads)
    path = checkpoint_file(settings.checkpoint)
    renderer = load_renderer(path, settings.vae)
    if settings.bounces == 0 and "lit" in renderer.config.guidance:
        what = "the network is given lit, which has no bounced light with bounces=0 (fidelity=paper sets it)"
        raise TronError(what, path, "give bounces=4, or take a checkpoint of pbr and irradiance")
    _check_drawing(settings, renderer, path)
    log.info("Network: checkpoint %s, of %s", settings.checkpoint, ", ".join(renderer.config.guidance))
    return renderer.to(torch_device(settings.variant))


def _check_drawing(settings: Settings, renderer: Renderer, path: Path) -> None:
    try:
        check_frames(settings.window or renderer.config.window, renderer.temporal_factor)
        renderer.check_weights(settings.weights)
    except TronError as error:
        raise TronError(error.what, path, error.mend) from error
