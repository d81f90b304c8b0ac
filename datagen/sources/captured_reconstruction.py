"""Find surfels and light of a capture once, and keep them beside the shards.

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
from datagen.dataset.records import CONFIG_NAME, WORK, Work
from datagen.settings.command import Settings
from tron.captures import Capture, LoadSettings, load_capture
from tron.cli.instantiation import make as make_object
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.reconstruction import Prior, Reconstruction, reconstruct
from tron.reconstruction.geometry.training import Stage, StepSummary
from tron.reconstruction.light.surfel_colors import mean_colors, observe
from tron.reconstruction.pipeline import require_same_run
from tron.reconstruction.scores import mean_figures
from tron.reconstruction.settings import ReconstructionSettings
from tron.run_folder import RunFolder
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap
from tron.storage import atomic_path, write_atomic
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

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
    """Stored reconstruction of a capture.

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
    """Raise TronError if the prior cannot be made, before any capture is read."""
    make_object(settings.captured.prior, "captured.prior")


def tell(item: Work, phase: str) -> None:
    """Log the start of one of :data:`PHASES`."""
    log.info("%s (%s): %s", item.name, item.capture, PHASES[phase])


def load(item: Work, settings: Settings, folder: Path, reduced: bool) -> Capture:
    """Load the capture with photos at the size of the reconstruction, or at full size.

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
    """Silence log lines of reading a capture."""
    teller = logging.getLogger(tron.captures.__name__)
    before = teller.level
    teller.setLevel(logging.ERROR)
    try:
        yield
    finally:
        teller.setLevel(before)


def kept(folder: Path, capture: Capture) -> Found | None:
    """Load the stored result for the same photos; None if it has to be made (again)."""
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
    wanted = settings.captured
    seed = integer(settings.seed, "captured", item.capture, "reconstruction", bits=31)
    how = wanted.reconstruction.model_copy(update={"seed": seed})
    prior = make_object(wanted.prior, "captured.prior")
    prior.check(capture)  # what cannot be had is said before long work
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

    light = wanted.light.model_copy(update={"seed": seed})
    found = reconstruct(capture, prior, how, light=light, checkpoint=checkpoint, watch=watch)
    if found.light is None:
        raise TronError(
            "no light was found: the photos show too few surfels, or the prior gives no irradiance",
            mend="take more photos, larger ones (captured.photos.max_side), more steps, or prior=joint",
        )
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
        "light": found.light.said,
        "scores": _scores(found, capture),
        "gains": {
            view.name: [round(float(gain), 6) for gain in gains]
            for view, gains in zip(capture.train_views, _gains(found, capture))
        },
    }
    found.scene.save(folder / SURFELS_NAME)
    found.light.environment.save(folder / ENVIRONMENT_NAME)
    write_atomic(folder / SPEC_NAME, json.dumps(facts, indent=1) + "\n")


def _drop_other(checkpoint: Path, capture: Capture, prior: Prior, how: ReconstructionSettings) -> None:
    """Remove a damaged checkpoint, or one of other photos: it would stop every later run."""
    try:
        require_same_run(checkpoint, capture, prior, how)
    except TronError as error:
        log.warning("%s: it begins anew", error)
        checkpoint.unlink()


def _gains(found: Reconstruction, capture: Capture) -> np.ndarray:
    """Return exposure and white balance of the training photos (V, 3), from the prior or the surfels."""
    if found.gains is not None:
        return found.gains
    tracer = SurfelTracer(found.scene)
    return mean_colors(observe(tracer, capture.train_views, capture.exposure, capture.tone_curve)).gain


def _scores(found: Reconstruction, capture: Capture) -> Mapping[str, Any]:
    """Return mean figures of the held-out photos, or of some others if none is held out."""
    figures = mean_figures(found.scores["test" if capture.test else "train"])
    return {"of": "held-out" if capture.test else "training"} | {
        name: round(value, 4) for name, value in figures.items()
    }


DECIDES = ("prior", "photos", "reconstruction", "light")
"""Keys of ``captured`` that decide what a reconstruction is, beside seed and variant."""

FOUND = (SURFELS_NAME, ENVIRONMENT_NAME)
"""Files of a reconstruction beside its spec.json."""


def require_reusable(settings: Settings) -> None:
    """Require that ``captured.reconstructed`` is a dataset of captures with the same reconstruction settings.

    Raises:
        TronError: it is not; names the first key that differs.
    """
    folder = settings.captured.reconstructed
    if folder is None:
        return
    mend = "leave captured.reconstructed out, or give the keys that they were made with"
    run = RunFolder(folder, "reconstructions", CONFIG_NAME, mend)
    described = run.recipe()
    if described is None or described.get("recipe", {}).get("source") != "captured":
        mend = "give the folder of a dataset made with source=captured"
        raise TronError("captured.reconstructed is no dataset of captures", folder, mend)
    run.require(_decisive(settings.recipe()), _decisive(described["recipe"]))


def take_over(item: Work, settings: Settings, capture: Capture, folder: Path) -> bool:
    """Copy the reconstruction of the same photos into a scene's folder, spec.json last; False without one."""
    source = settings.captured.reconstructed
    for spec in sorted(source.glob(f"scenes/*/{SPEC_NAME}")) if source is not None else ():
        try:
            text = spec.read_text("utf-8")
            facts = json.loads(text)
            same = facts["capture"] == item.capture and facts["content"] == capture.content
            same = same and all((spec.parent / name).is_file() for name in FOUND)
        except (OSError, ValueError, KeyError, TypeError):
            continue
        if same:
            log.info("%s (%s): reconstruction of %s", item.name, item.capture, spec.parent)
            for name in FOUND:
                with atomic_path(folder / name) as path:
                    shutil.copyfile(spec.parent / name, path)
            write_atomic(folder / SPEC_NAME, text)
            return True
    return False


def _decisive(recipe: dict[str, Any]) -> dict[str, Any]:
    captured = {name: recipe.get("captured", {}).get(name) for name in DECIDES}
    return {"seed": recipe.get("seed"), "variant": recipe.get("variant"), "captured": captured}
