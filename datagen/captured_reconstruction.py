"""Surfels and light of a capture, found once and kept beside the shards.

Poses of bare photos and the checkpoint of the reconstruction are kept in ``scenes/NAME/work`` until the scene
is finished. Surfels and light are written when they are found, and are read back by whoever goes on from
there, the run that found them included: so a run that was killed gives the same bytes.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import tron.captures
from datagen.plan import Work
from datagen.settings import Settings
from tron.captures import Capture, LoadSettings, load_capture
from tron.cli.instantiation import make as make_object
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.priors import Prior
from tron.reconstruction import Joint, Reconstruction, fit_environment, reconstruct
from tron.reconstruction.checkpoint import Checkpoint
from tron.reconstruction.evaluation import mean_figures, score_views
from tron.reconstruction.evidence import gather_evidence
from tron.reconstruction.observations import observe
from tron.reconstruction.pipeline import made_with
from tron.reconstruction.settings import ReconstructionSettings
from tron.reconstruction.training import Stage, StepSummary
from tron.runtime import torch_device
from tron.seeds import integer
from tron.shading.environment import EnvironmentMap
from tron.storage import write_atomic
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

WORK = "work"
"""Folder within a scene's that is there until it is finished."""
CHECKPOINT = "checkpoint.safetensors"
SPEC_NAME = "spec.json"
ENVIRONMENT_NAME = "environment.exr"
SURFELS_NAME = "surfels.ply"
CACHE_BYTES = 500_000_000
"""Decoded photos in a worker's memory."""

PHASES = {
    "read": "reading photos and poses",
    "first": "first surfels",
    "learn": "surfels are learnt from photos",
    "light": "light and materials",
    "guidance": "guidance of its photos",
    "write": "writing its clips",
}
"""Phases of a capture as the log tells them, in order; a rerun begins with the one that it goes on from."""


@dataclass(frozen=True)
class Found:
    """Reconstruction of a capture, as it is kept.

    Attributes:
        scene: surfels with materials.
        environment: the light, in the unit of the photos over the capture's exposure.
        gains: name of a photo -> (3,) its exposure and white balance over those of the mean photo, linear.
        facts: what else spec.json says.
    """

    scene: GaussianScene
    environment: EnvironmentMap
    gains: dict[str, np.ndarray]
    facts: dict[str, Any]


def require_prior(settings: Settings) -> None:
    """Raise TronError where the prior cannot be made, before any capture is read."""
    make_object(settings.captured.prior, "captured.prior")


def clear_work(folder: Path) -> None:
    """Remove what a finished capture needs no more."""
    shutil.rmtree(folder / WORK, ignore_errors=True)


def tell(item: Work, phase: str) -> None:
    """Say in the log which of :data:`PHASES` begins."""
    log.info("%s (%s): %s", item.name, item.capture, PHASES[phase])


def load(item: Work, settings: Settings, folder: Path, reduced: bool) -> Capture:
    """The capture, its photos as large as the reconstruction wants them or as they are.

    What is wrong with photos is told of the reduced ones alone: of the others it is the same.
    """
    wanted = settings.captured.photos
    whole = {} if reduced else {"max_side": None, "downscale": None}
    assert settings.captures is not None
    how = LoadSettings(
        **{**{name: getattr(wanted, name) for name in type(wanted).model_fields}, **whole},
        workspace=folder / WORK / "structure_from_motion",
        threads=1,
        seed=integer(settings.seed, "captured", item.capture, "poses", bits=31),
        cache_bytes=CACHE_BYTES,
    )
    with nullcontext() if reduced else _quiet_reading():
        return load_capture(settings.captures / item.capture, how)


@contextmanager
def _quiet_reading() -> Iterator[None]:
    """Say nothing of what reading a capture finds."""
    teller = logging.getLogger(tron.captures.__name__)
    before = teller.level
    teller.setLevel(logging.ERROR)
    try:
        yield
    finally:
        teller.setLevel(before)


def kept(folder: Path, capture: Capture) -> Found | None:
    """Findings of a run on the same photos; None where there are none, and it has to be done (again)."""
    try:
        facts = json.loads((folder / SPEC_NAME).read_text("utf-8"))
        if facts["content"] != capture.content:
            log.warning("%s: photos have changed since it was reconstructed: it begins anew", folder)
            return None
        return Found(
            GaussianScene.load(folder / SURFELS_NAME).validate(),
            EnvironmentMap.load(folder / ENVIRONMENT_NAME),
            {name: np.asarray(gain, np.float64) for name, gain in facts["gains"].items()},
            facts,
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, TronError):
        return None


def find(item: Work, settings: Settings, capture: Capture, folder: Path) -> None:
    """Find surfels and light, and write surfels.ply, environment.exr and, at last, spec.json."""
    wanted, device = settings.captured, torch_device(settings.variant)
    seed = integer(settings.seed, "captured", item.capture, "reconstruction", bits=31)
    how = wanted.reconstruction.model_copy(update={"seed": seed})
    prior = _prior(settings, capture)
    (folder / WORK).mkdir(parents=True, exist_ok=True)
    checkpoint = folder / WORK / CHECKPOINT
    _drop_other(checkpoint, capture, prior, how)
    tell(item, "first")
    told: set[str] = set()

    def watch(progress: StepSummary, stage: Stage) -> None:  # noqa: ARG001 as reconstruct asks
        phase = "light" if progress.stage != "radiance" or progress.step == progress.steps else "learn"
        if phase not in told:
            told.add(phase)
            tell(item, phase)

    found = reconstruct(capture, prior, how, checkpoint=checkpoint, device=device, watch=watch)
    tracer = SurfelTracer(found.scene)
    environment = _light(settings, found, tracer, seed)
    facts = {
        "capture": item.capture,
        "content": capture.content,
        "views": len(capture.views),
        "held_out": sorted(capture.test),
        "skipped": dict(capture.skipped),
        "first_surfels": found.source,
        "stereo_confident": found.confident,
        "surfels": len(found.scene),
        "materials": list(found.learnt),
        "light": None if found.explanation is None else found.explanation.said(),
        "scores": _scores(tracer, capture, how.radiance.background),
        "gains": {
            name: [round(float(gain), 6) for gain in gains]
            for name, gains in _gains(found, tracer, prior).items()
        },
    }
    found.scene.save(folder / SURFELS_NAME)
    environment.save(folder / ENVIRONMENT_NAME)
    write_atomic(folder / SPEC_NAME, json.dumps(facts, indent=1) + "\n")


def _drop_other(
    checkpoint: Path, capture: Capture, prior: Prior | Joint, how: ReconstructionSettings
) -> None:
    """Remove a checkpoint of other photos, or one that is damaged: it would stop every later run."""
    if not checkpoint.exists():
        return
    try:
        Checkpoint(checkpoint).require(made_with(capture, prior, how))
    except TronError as error:
        log.warning("%s: it begins anew", error)
        checkpoint.unlink()


def _prior(settings: Settings, capture: Capture) -> Prior | Joint:
    """The prior; photos went through their capture's tone curve, whatever the settings guess."""
    prior = make_object(settings.captured.prior, "captured.prior")
    if isinstance(prior, Joint):
        return prior.model_copy(update={"tone_curve": capture.tone_curve})
    prior.fields(capture)  # what cannot be had is said before long work
    return prior


def _light(settings: Settings, found: Reconstruction, tracer: SurfelTracer, seed: int) -> EnvironmentMap:
    """Light of the joint fit, or Algorithm 2's.

    Raises:
        TronError: too few surfels are seen for the one, or the prior gives no irradiance for the other.
    """
    if found.explanation is not None:
        return found.explanation.environment
    if not any(view.has("irradiance") for view in found.capture.train_views):
        raise TronError(
            "no light was found: the photos show too few surfels, or the prior gives no irradiance",
            mend="take more photos, larger ones (captured.photos.max_side), more steps, or prior=joint",
        )
    return fit_environment(
        found.capture, tracer, settings.captured.light.model_copy(update={"seed": seed})
    ).environment


def _gains(found: Reconstruction, tracer: SurfelTracer, prior: Prior | Joint) -> dict[str, np.ndarray]:
    """Exposure and white balance of each training photo, those that the light was found with."""
    views = found.capture.train_views
    if found.explanation is not None:
        evidence = found.explanation.evidence
    else:
        same = isinstance(prior, Joint) and prior.same_exposure
        seen = observe(tracer, views, found.capture.exposure, found.capture.tone_curve)
        evidence = gather_evidence(seen, same)
    return {view.name: gain for view, gain in zip(views, evidence.gain)}


def _scores(tracer: SurfelTracer, capture: Capture, background: str) -> Mapping[str, Any]:
    """Mean figures of the held-out photos, or of at most eight of the others where none is held out."""
    train = capture.train_views
    views = capture.test_views or train[:: max(1, len(train) // 8)]
    figures = mean_figures(score_views(tracer, views, background))
    return {"of": "held-out" if capture.test else "training"} | {
        name: round(value, 4) for name, value in figures.items()
    }
