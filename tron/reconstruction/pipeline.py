"""Capture -> GaussianScene, the paper's Algorithm 1: radiance and geometry, then materials from priors.

The run is a chain of stages with one checkpoint behind it: whoever calls again with the same capture,
settings and checkpoint goes on where the last call was cut off.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tron.captures import Capture, View
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.gaussians.fields import MATERIALS
from tron.gaussians.harmonics import SH_C0
from tron.gaussians.scene import GaussianScene
from tron.priors import Prior, Track, apply_prior, untracked
from tron.reconstruction.checkpoint import Checkpoint, save_checkpoint
from tron.reconstruction.enclosure import enclosed
from tron.reconstruction.explanation import Explanation, explain
from tron.reconstruction.initial import Beginning, beginning, extent_of, place_of, source_of
from tron.reconstruction.joint import Joint
from tron.reconstruction.joint_light import TooFewSeen
from tron.reconstruction.settings import ReconstructionSettings
from tron.reconstruction.surfels import LearntSurfels
from tron.reconstruction.training import Plan, Stage, StepSummary, Watch, materials_plan, radiance_plan
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reconstruction:
    """Result of stages 1 and 2.

    Attributes:
        scene: surfels with radiance and materials.
        capture: the capture; its training views carry the prior's maps, if it gives any.
        seconds: of the stages, those before an interruption included.
        learnt: the materials that were learnt; the others are what surfels begin with.
        source: of the first surfels.
        confident: share of the subject's pixels whose depth stereo found and other photos confirm; None where
            stereo was not asked.
        explanation: light and materials together, where the prior is :class:`Joint`.
    """

    scene: GaussianScene
    capture: Capture
    seconds: float
    learnt: tuple[str, ...]
    source: str
    confident: float | None
    explanation: Explanation | None = None


def reconstruct(
    capture: Capture,
    prior: Prior | Joint,
    settings: ReconstructionSettings,
    *,
    checkpoint: Path | None = None,
    device: str = "cpu",
    watch: Watch | None = None,
    track: Track = untracked,
) -> Reconstruction:
    """Find the surfels of a capture, whose images are display values.

    Args:
        capture: training views are learnt from, the others never looked at.
        prior: gives normals to stage 1 and materials to stage 2, as far as it can; ``Joint`` finds materials
            and light together after stage 1.
        settings: schedules, rates, seed.
        checkpoint: file to keep the state in and to go on from; None keeps none.
        device: torch's, that of the active Mitsuba variant.
        watch: called after each step.
        track: wraps long loops.

    Raises:
        TronError: fewer than two training views, images that are not display values, a checkpoint made with
            other settings or damaged, or numbers that are no longer finite.
    """
    views = capture.train_views
    if len(views) < 2:
        raise TronError(
            "a reconstruction needs at least two training views", mend="add photos from elsewhere"
        )
    linear = [view.name for view in views if view.space != "display"]
    if linear:
        raise TronError(
            "surfels are learnt from display values and an image is linear",
            f"view {linear[0]}",
            "encode it for display",
        )
    run = _Run(settings, made_with(capture, prior, settings), checkpoint, device, watch)
    extent = extent_of(views)
    source_of(capture, settings.initial)  # a lacking one is told before a prior works for hours
    taught, given = capture, False
    if settings.radiance.normal > 0 and not isinstance(prior, Joint):
        taught = apply_prior(capture, prior, fields=["normal"], track=track)
        given = any(view.has("normal") for view in taught.train_views)
    most = settings.radiance.density.most
    first = run.begin(lambda: beginning(taught, settings.initial, settings.seed, most, device, track))
    radiance = settings.radiance.scaled(settings.steps_scaler, place_of(run.begun["source"]))
    plan = radiance_plan(radiance, extent, settings.seed, normals_given=given, tone_curve=capture.tone_curve)
    surfels = run.stage(plan, taught.train_views, first)
    scene = surfels.scene(settings.initial.kernel_degree, capture.up)
    if settings.indoors and not run.past(plan.name):
        scene = enclosed(scene, views, settings.seed, track)
    if isinstance(prior, Joint):
        try:
            found = explain(capture, scene, prior, settings.seed, device, track)
        except TooFewSeen as error:  # surfaces were not found: that is no reason to lose what was
            log.warning("%s: base color is what the photos show, and there is no environment.exr", error)
            return Reconstruction(
                _with_baked_color(scene).validate(), capture, run.seconds(), (), **run.begun
            )
        return Reconstruction(
            found.scene.validate(), capture, run.seconds(), MATERIALS, explanation=found, **run.begun
        )

    tracer = SurfelTracer(scene)
    taught = apply_prior(
        capture, prior, gbuffers=lambda view: tracer.gbuffer(view.camera).numpy(), track=track
    )
    fields = tuple(name for name in MATERIALS if any(view.has(name) for view in taught.train_views))
    plan = materials_plan(settings.materials.scaled(settings.steps_scaler))
    plan = plan.learning(fields)
    scene = _with_baked_color(scene)
    if fields:
        learners = [view for view in taught.train_views if any(view.has(name) for name in fields)]
        scene = run.stage(plan, learners, lambda: scene).scene(settings.initial.kernel_degree, capture.up)
    for name in (name for name in MATERIALS if name not in fields):
        log.warning("no prior for %s: it stays what surfels begin with", name)
    return Reconstruction(scene.validate(), taught, run.seconds(), fields, **run.begun)


def made_with(capture: Capture, prior: Prior | Joint, settings: ReconstructionSettings) -> dict[str, Any]:
    """All that a reconstruction is a function of, as plain values: a checkpoint of others is refused."""
    values = settings.model_dump(mode="json", exclude={"checkpoint_every"})
    return {"capture": capture.content, "prior": repr(prior), **values}


class _Run:
    """Stages in a row, with the checkpoint behind them."""

    def __init__(
        self,
        settings: ReconstructionSettings,
        values: Mapping[str, Any],
        path: Path | None,
        device: str,
        watch: Watch | None,
    ) -> None:
        self.settings, self.values, self.path, self.device, self.watch = settings, values, path, device, watch
        self.found = Checkpoint(path) if path is not None and path.exists() else None
        self.before = self.found.seconds if self.found else 0.0
        self.begun: dict[str, Any] = self.found.begun if self.found else {}
        self.started = time.perf_counter()
        if self.found is not None:
            self.found.require(self.values)
            log.info("resuming from step %d of stage %s", self.found.step, self.found.stage)

    def begin(self, find: Callable[[], Beginning]) -> Callable[[], GaussianScene]:
        """Maker of the first surfels: they are found now, unless a checkpoint has gone on from them."""
        if self.found is not None:
            return lambda: find().scene
        first = find()
        self.begun = {"source": first.source, "confident": first.confident}
        return lambda: first.scene

    def seconds(self) -> float:
        """Spent on the run, interrupted parts included."""
        return self.before + time.perf_counter() - self.started

    def past(self, stage: str) -> bool:
        """Whether the checkpoint that the run goes on from lies behind a stage."""
        return self.found is not None and _ORDER.index(self.found.stage) > _ORDER.index(stage)

    def stage(self, plan: Plan, views: Sequence[View], begin: Callable[[], GaussianScene]) -> LearntSurfels:
        """Run a stage to its end, from the checkpoint if that lies in it or behind it."""
        degree, seed = self.settings.initial.kernel_degree, self.settings.seed
        found = self.found
        if found is not None and self.past(plan.name):
            # A later stage is under way: this one's surfels are those of the checkpoint.
            return found.surfels(plan.rates, self.device)
        if found is not None and found.stage == plan.name:
            stage = Stage(plan, views, found.surfels(plan.rates, self.device), degree, seed)
            found.resume(stage)
        else:
            surfels = LearntSurfels.of_scene(begin(), plan.rates, self.device)
            stage = Stage(plan, views, surfels, degree, seed)
        stage.run(self._after)
        self._save(stage)
        return stage.surfels

    def _after(self, progress: StepSummary, stage: Stage) -> None:
        if progress.step % self.settings.checkpoint_every == 0 and progress.step < progress.steps:
            self._save(stage)
        if self.watch is not None:
            self.watch(progress, stage)

    def _save(self, stage: Stage) -> None:
        if self.path is not None:
            save_checkpoint(self.path, stage, self.values, self.seconds(), self.begun)


_ORDER = ("radiance", "materials")


def _with_baked_color(scene: GaussianScene) -> GaussianScene:
    """Base color begins as the radiance of all directions, decoded from sRGB."""
    baked = srgb_to_linear(np.clip(SH_C0 * scene.sh[:, 0] + 0.5, 0, 1))
    return replace(scene, base_color=baked.astype(np.float32))
