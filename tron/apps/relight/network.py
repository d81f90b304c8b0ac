"""Who draws the pictures of tron-relight: a network, a denoiser, or neither."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tron.apps.relight.settings import Settings
from tron.cli.installation import lacks_extra
from tron.denoising import DENOISERS, lacking
from tron.errors import TronError, located
from tron.neural.clips import check_frames
from tron.neural.network_gains import NETWORK, Way, best_first, quality_of
from tron.neural.shipped import DEFAULT, checkpoint_file
from tron.runtime import set_torch_threads, torch_device
from tron.shards.schema import GUIDANCE
from tron.storage import sha256

if TYPE_CHECKING:
    from tron.neural.protocols import Renderer

log = logging.getLogger(__name__)


def chosen_network(settings: Settings) -> tuple[Settings, Renderer | None]:
    """The settings as they will be followed, and the network on its device, or None without one.

    A checkpoint that was asked for has to fit. checkpoint=auto takes what surely gains most at that size and
    quality (:mod:`tron.neural.network_gains`): the shipped network, a denoiser that is installed where light
    bounces, or neither; a line in the log says which, and by how much. The network gives way where its
    libraries or its file are not installed; where nothing bounces and it is given lit; where denoise= names a
    denoiser. Radiance that is asked for stays as it was traced. Where window, overlap, reproject or
    weights are chosen, the network has to fit too.

    Raises:
        TronError: the checkpoint is missing, damaged, or does not fit the settings.
    """
    if settings.checkpoint is None:
        return settings, None
    if not settings.takes_default:
        renderer = _loaded(settings)
        if isinstance(renderer, TronError):
            raise renderer
        return settings, renderer
    estimation, (width, height) = settings.estimation(), settings.size
    quality = quality_of(estimation.supersample, estimation.reflections)
    gains = best_first(_ways(settings), quality, width, height)
    found = f"at least on validation scenes, {quality} at {width} x {height}"
    titles = {way: DEFAULT if way == NETWORK else DENOISERS[way].title for way in gains}
    for way, gain in gains.items():
        others = [f"; {titles[each]} {dB:+.2f}" for each, dB in gains.items() if each != way]
        said = "".join([f"{gain:+.2f} dB {found}", *others])
        if way != NETWORK:
            if gain > 0:
                log.info("%s draws the pictures: %s", titles[way], said)
                return settings.model_copy(update={"checkpoint": None, "denoise": way}), None
            continue
        drawn = settings.model_copy(update={"checkpoint": Path(DEFAULT)})
        renderer = _unwanted(settings, gain, said) or _loaded(drawn)
        if not isinstance(renderer, TronError):
            log.info("%s draws the pictures: %s", DEFAULT, said)
            return drawn, renderer
        if settings.tuned:
            raise renderer
        log.info("No network: %s", renderer)
    return settings.model_copy(update={"checkpoint": None}), None


def _ways(settings: Settings) -> list[Way]:
    """What checkpoint=auto chooses from.

    A denoiser is no answer to settings of a network, and leaves radiance that is asked for as it is.
    """
    if not settings.bounces or settings.denoise is not True or settings.tuned or "relit" in settings.buffers:
        return [NETWORK]
    return [NETWORK, *(name for name in DENOISERS if lacking(name, "checkpoint=auto") is None)]


def _unwanted(settings: Settings, gain: float, said: str) -> TronError | None:
    """Why checkpoint=auto does without the shipped network before it is loaded; None: it does not."""
    if settings.denoiser is not None:
        return TronError(f"denoise={settings.denoiser} draws the pictures")
    if "relit" in settings.buffers:
        return TronError("buffers ask for relit.exr, and a network draws display values")
    if gain > 0:
        return None
    mend = f"give checkpoint={DEFAULT} to have it all the same"
    return TronError(f"{DEFAULT} gains nothing for sure: {said}", mend=mend)


def _loaded(settings: Settings) -> Renderer | TronError:
    """The network of the checkpoint, on its device; or why it cannot draw.

    Raises:
        TronError: window or weights were chosen, and do not fit it.
    """
    assert settings.checkpoint is not None
    if (absent := lacks_extra("checkpoint", "network")) is not None:
        return absent
    from tron.neural.weights import load_renderer

    if settings.threads is not None:
        set_torch_threads(settings.threads)
    try:
        path = checkpoint_file(settings.checkpoint)
        renderer = load_renderer(path, settings.vae)
    except TronError as unreadable:
        return unreadable
    except ModuleNotFoundError:  # diffusers, of networks that are transformers
        if (absent := lacks_extra(f"checkpoint {settings.checkpoint}", "train")) is None:
            raise
        return absent
    if settings.bounces == 0 and "lit" in renderer.config.guidance:
        what = "the network is given lit, which has no bounced light with bounces=0 (fidelity=paper sets it)"
        return TronError(what, path, "give bounces=4, or take a checkpoint of pbr and irradiance")
    with located(path):
        check_frames(settings.window or renderer.config.window, renderer.temporal_factor)
        renderer.check_weights(settings.weights)
    log.info("Network: checkpoint %s, of %s", settings.checkpoint, ", ".join(renderer.config.guidance))
    return renderer.to(torch_device())


def shown_guidance(settings: Settings, renderer: Renderer | None) -> list[str]:
    """Buffers that are shown beside the relit picture: those that the network is given, where there is one.

    Without one the relit picture is one of them, and is shown as such; so is lit if nothing bounces.
    """
    if renderer is not None:
        return list(renderer.config.guidance)
    return [name for name in GUIDANCE if name != settings.source and (settings.bounces or name != "lit")]


def averaged_frames_of(settings: Settings, frames: int) -> int:
    """Frames that each one is the mean of along the camera's motion: 1 where anything else moves or turns."""
    turns = len(set(settings.rotations(frames))) > 1 or settings.motion is not None
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
