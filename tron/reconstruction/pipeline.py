"""The one door from a capture to a relightable scene, whatever the prior (the paper's Algorithms 1 and 2).

The run is a chain of stages with one checkpoint behind it: whoever calls again with the same capture,
settings and checkpoint goes on where the last call was cut off. With a checkpoint, SIGTERM and Ctrl-C amid a
stage finish the step in hand and keep it; before and between stages they end the call at once. A checkpoint
is one safetensors file of everything that the next step depends on: numbers, and nothing that could run. It
replaces the one before it, whole or not at all.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from tron.captures import Capture, View
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.gaussians.fields import MATERIALS
from tron.gaussians.harmonics import SH_C0
from tron.gaussians.scene import GaussianScene
from tron.metrics import LPIPS
from tron.reconstruction.geometry.initial import Beginning, beginning, extent_of, place_of, source_of
from tron.reconstruction.geometry.room import closed_indoors
from tron.reconstruction.geometry.surfels import LearntSurfels
from tron.reconstruction.geometry.training import (
    Plan,
    Stage,
    StepSummary,
    Watch,
    materials_plan,
    radiance_plan,
)
from tron.reconstruction.materials.carried import Carried
from tron.reconstruction.priors.prior import FIELDS, Light, Prior, Surfels
from tron.reconstruction.progress import Track, untracked
from tron.reconstruction.scores import LOOKS, Seen, ViewScore, score_views
from tron.reconstruction.settings import FitSettings, ReconstructionSettings
from tron.relighting import Relighter
from tron.relighting.proxy import THICK, Proxy, thickness
from tron.run_folder import RunFolder
from tron.storage import write_atomic
from tron.termination import Termination, termination_noted
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

TRAIN_VIEWS_SCORED = 8

_LINE = "stopping behind the step in hand, with a checkpoint; once more after five seconds stops at once"
_ORDER = ("radiance", "materials")
_FORMAT = "tron-reconstruction 2"


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A relightable scene, its light, and how good they are.

    Attributes:
        scene: surfels with radiance and materials.
        light: None where none was asked for or none could be found, which the log says.
        scores: figures of each held-out view ("test") and of at most TRAIN_VIEWS_SCORED others ("train");
            those of a room's pictures are of the surfels before windows were opened.
        learnt: the materials that were found; the others are what surfels begin with.
        gains: (V, 3) linear exposure and white balance of the training photos, where the prior finds them.
        source: of the first surfels.
        confident: share of the subject's pixels whose depth stereo found and other photos confirm; None where
            stereo was not asked.
        seconds: of surfels with materials, those before an interruption included, and of the light.
        proxy: what light sees of the surfels; None: themselves.
        opened: surfels that showed the sky in a room's windows and were taken out.
    """

    scene: GaussianScene
    light: Light | None
    scores: dict[str, list[ViewScore]]
    learnt: tuple[str, ...]
    gains: np.ndarray | None
    source: str
    confident: float | None
    seconds: dict[str, float]
    proxy: Proxy | None = None
    opened: int = 0


def reconstruct(
    capture: Capture,
    prior: Prior,
    settings: ReconstructionSettings,
    *,
    light: FitSettings | None = None,
    checkpoint: Path | None = None,
    lpips: LPIPS | None = None,
    watch: Watch | None = None,
    track: Track = untracked,
) -> Reconstruction:
    """Find surfels, materials and light of a capture, whose images are display values.

    Where the capture films a scan, its surfels stay, and get materials (:meth:`Prior.carry`); there is no
    checkpoint of that. Where they cannot, which the log says, new ones are learnt.

    Args:
        capture: training views are learnt from, the others only scored.
        prior: gives normals to stage 1, and finds materials and light on its surfels.
        settings: schedules, rates, seed.
        light: settings of the light's fit; None finds no light.
        checkpoint: file to keep the state in and to go on from; None keeps none.
        lpips: scores LPIPS as well.
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
    prior.check(capture)
    if capture.scan is not None:
        started = time.perf_counter()
        carried = prior.carry(capture, settings.seed, track)
        if carried is not None:
            return _kept(carried, capture, settings, light, lpips, track, time.perf_counter() - started)
        log.warning("the scan's surfels are not kept: new ones are learnt")
    run = _Run(settings, made_with(capture, prior, settings), checkpoint, watch)
    extent = extent_of(views)
    source_of(capture, settings.initial)  # a lacking one is told before a prior works for hours
    fields = [name for name in FIELDS if name != "normal" or settings.radiance.normal > 0]
    taught = prior.teach(capture, fields, track)
    given = taught is not capture and any(view.has("normal") for view in taught.train_views)
    pixels = int(np.median([view.camera.width * view.camera.height for view in taught.train_views]))
    density = settings.radiance.density.seen_in(pixels)
    first = run.begin(lambda: beginning(taught, settings.initial, settings.seed, density.most, track))
    radiance = settings.radiance.model_copy(update={"density": density})
    radiance = radiance.scaled(settings.steps_scaler, place_of(run.begun["source"]))
    given &= settings.radiance.normal > 0
    plan = radiance_plan(radiance, extent, settings.seed, normals_given=given, tone_curve=capture.tone_curve)
    surfels = run.stage(plan, taught.train_views, first)
    degree = settings.initial.kernel_degree
    scene = replace(surfels.scene(degree, capture.up), offset=capture.offset)
    if not run.past(plan.name):
        closed, opened = closed_indoors(
            scene, views, settings.indoors, settings.seed, capture.tone_curve, track
        )
        if closed is not scene:
            # Windows show whatever light there is from now on, not the photos'.
            run.begun["looks"] = _looks(
                _scores(SurfelTracer(scene.validate()), capture, settings, lpips, track)
            )
            run.begun["opened"] = opened
        scene = closed
    scene = _with_baked_color(scene)

    def learn(names: Collection[str]) -> GaussianScene:
        plan = materials_plan(settings.materials.scaled(settings.steps_scaler)).learning(names)
        learners = [view for view in taught.train_views if any(view.has(name) for name in names)]
        learnt = run.stage(plan, learners, lambda: scene).scene(degree, capture.up)
        return replace(learnt, offset=capture.offset)

    frozen = Surfels(taught, scene, learn, settings.seed, track)
    found = prior.find_materials(frozen)
    tracer = SurfelTracer(found.scene.validate())
    proxy = found.proxy
    if proxy is not None and thickness(tracer, [view.camera for view in views]) < THICK:
        proxy = None
    seconds, started = {"surfels": run.seconds()}, time.perf_counter()
    lit = None
    if light is not None:
        lit = found.light or prior.find_light(frozen, tracer, light)
    seconds["light"] = time.perf_counter() - started
    seen = tracer if proxy is None else Relighter(found.scene, proxy=proxy)
    scores = _scores(seen, capture, settings, lpips, track)
    begun = dict(run.begun)
    if looks := begun.pop("looks", None):
        scores = _as_they_looked(scores, looks)
    return Reconstruction(
        found.scene, lit, scores, found.learnt, found.gains, seconds=seconds, proxy=proxy, **begun
    )


def _scores(
    seen: Seen, capture: Capture, settings: ReconstructionSettings, lpips: LPIPS | None, track: Track
) -> dict[str, list[ViewScore]]:
    views = capture.train_views
    judged = {"test": capture.test_views, "train": views[:: max(1, len(views) // TRAIN_VIEWS_SCORED)]}
    background = settings.radiance.background
    return {which: score_views(seen, some, background, lpips, track) for which, some in judged.items()}


def _looks(scores: Mapping[str, Sequence[ViewScore]]) -> dict[str, dict[str, dict[str, float]]]:
    """Figures of pictures by set and view, as plain values."""
    return {
        which: {
            score.view: {name: score.figures[name] for name in LOOKS if name in score.figures}
            for score in some
        }
        for which, some in scores.items()
    }


def _as_they_looked(
    scores: Mapping[str, Sequence[ViewScore]], looks: Mapping[str, Mapping[str, Mapping[str, float]]]
) -> dict[str, list[ViewScore]]:
    """Scores with figures of pictures from :func:`_looks`."""
    return {
        which: [ViewScore(score.view, {**score.figures, **looks[which][score.view]}) for score in some]
        for which, some in scores.items()
    }


def _kept(
    carried: Carried,
    capture: Capture,
    settings: ReconstructionSettings,
    light: FitSettings | None,
    lpips: LPIPS | None,
    track: Track,
    seconds: float,
) -> Reconstruction:
    """The reconstruction of a scan whose surfels stay."""
    seen = Relighter(carried.scene.validate(), proxy=carried.proxy)
    lit = None if light is None else Light(carried.fit.environment, carried.said())
    return Reconstruction(
        carried.scene, lit, _scores(seen, capture, settings, lpips, track), MATERIALS, None, source="scan",
        confident=None, seconds={"surfels": seconds, "light": 0.0}, proxy=carried.proxy,
    )  # fmt: skip


def made_with(capture: Capture, prior: Prior, settings: ReconstructionSettings) -> dict[str, Any]:
    """All that surfels are a function of, as plain values: a checkpoint of others is refused."""
    values = settings.model_dump(mode="json", exclude={"checkpoint_every"})
    return {"capture": capture.content, "prior": repr(prior), **values}


def require_same_run(
    checkpoint: Path, capture: Capture, prior: Prior, settings: ReconstructionSettings
) -> None:
    """Raise TronError where a checkpoint is damaged or of another run; nothing where there is none."""
    if checkpoint.exists():
        Checkpoint(checkpoint).require(made_with(capture, prior, settings))


class _Stopped(Exception):
    """End of a stage that was asked to end; what asked for it is raised in its place."""


class _Run:
    """Stages in a row, with the checkpoint behind them."""

    def __init__(
        self,
        settings: ReconstructionSettings,
        values: Mapping[str, Any],
        path: Path | None,
        watch: Watch | None,
    ) -> None:
        self.settings, self.values, self.path, self.watch = settings, values, path, watch
        self.found = Checkpoint(path) if path is not None and path.exists() else None
        self.before = self.found.seconds if self.found else 0.0
        self.begun: dict[str, Any] = self.found.begun if self.found else {}
        self.started = time.perf_counter()
        self._termination = Termination()
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
        """Run a stage to its end, from the checkpoint if that lies in it or behind it.

        Raises:
            KeyboardInterrupt, SystemExit: SIGINT or SIGTERM came; the step that was in hand is kept.
        """
        if self.path is None:
            return self._stage(plan, views, begin)
        with termination_noted(_LINE) as self._termination:
            return self._stage(plan, views, begin)

    def _stage(self, plan: Plan, views: Sequence[View], begin: Callable[[], GaussianScene]) -> LearntSurfels:
        degree, seed = self.settings.initial.kernel_degree, self.settings.seed
        found = self.found
        if found is not None and self.past(plan.name):
            # A later stage is under way: this one's surfels are those of the checkpoint.
            return found.surfels(plan.rates)
        if found is not None and found.stage == plan.name:
            stage = Stage(plan, views, found.surfels(plan.rates), degree, seed)
            found.resume(stage)
        else:
            surfels = LearntSurfels.of_scene(begin(), plan.rates)
            stage = Stage(plan, views, surfels, degree, seed)
        stage.run(self._after)
        self._save(stage)
        return stage.surfels

    def _after(self, progress: StepSummary, stage: Stage) -> None:
        if progress.step % self.settings.checkpoint_every == 0 and progress.step < progress.steps:
            self._save(stage)
        if self.watch is not None:
            self.watch(progress, stage)
        if self._termination.asked:
            self._save(stage)
            log.info("stopped: step %d of stage %s is kept", progress.step, progress.stage)
            raise _Stopped

    def _save(self, stage: Stage) -> None:
        if self.path is not None:
            save_checkpoint(self.path, stage, self.values, self.seconds(), self.begun)


def _with_baked_color(scene: GaussianScene) -> GaussianScene:
    """Base color begins as the radiance of all directions, decoded from sRGB."""
    baked = srgb_to_linear(np.clip(SH_C0 * scene.sh[:, 0] + 0.5, 0, 1))
    return replace(scene, base_color=baked.astype(np.float32))


def save_checkpoint(
    path: Path,
    stage: Stage,
    made_with: Mapping[str, Any],
    seconds: float,
    begun: Mapping[str, Any] | None = None,
) -> None:
    """Write where a stage stands.

    Args:
        path: the file.
        stage: under way, between two steps.
        made_with: plain values that a run must share to go on from here.
        seconds: spent on the run so far.
        begun: plain values that tell how the first surfels were found.
    """
    tensors = stage.surfels.state()
    if stage.plan.density is not None:
        tensors |= stage.plan.density.state()
    for part in (stage.exposures, stage.fused):
        tensors |= part.state() if part is not None else {}
    about = {
        **{"stage": stage.plan.name, "step": stage.step, "psnr": stage.psnr, "seconds": seconds},
        "begun": dict(begun or {}),
    }
    metadata = {
        "format": _FORMAT,
        "about": json.dumps(about),
        "made_with": json.dumps(made_with, sort_keys=True),
    }
    on_cpu = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_atomic(path, save(on_cpu, metadata))


class Checkpoint:
    """A checkpoint that was read.

    Raises:
        TronError: the file is unreadable or no such checkpoint.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                if metadata.get("format") != _FORMAT:
                    raise TronError("not a checkpoint of a reconstruction", path, "remove it to begin anew")
                about = json.loads(metadata["about"])
                self.made_with: dict[str, Any] = json.loads(metadata["made_with"])
                self.tensors: dict[str, Tensor] = {n: file.get_tensor(n) for n in file.keys()}  # noqa: SIM118 (no mapping)
        except (SafetensorError, OSError, KeyError, ValueError) as error:
            raise TronError(
                f"cannot read the checkpoint: {error}", path, "remove it to begin anew"
            ) from error
        self.stage: str = about["stage"]
        self.step: int = about["step"]
        self.psnr: float = about["psnr"]
        self.seconds: float = about["seconds"]
        self.begun: dict[str, Any] = about["begun"]

    def require(self, values: Mapping[str, Any]) -> None:
        """Raise TronError, naming the first key that differs, unless the checkpoint was made with these."""
        mend = "give the same settings, another output_dir, or overwrite=true"
        RunFolder(self.path, "a checkpoint", mend=mend).require(values, self.made_with)

    def surfels(self, rates: Mapping[str, float]) -> LearntSurfels:
        """The surfels as they were, moments of Adam included."""
        try:
            return LearntSurfels.of_state(self.tensors, rates)
        except KeyError as error:
            raise TronError(f"the checkpoint lacks {error}", self.path, "remove it to begin anew") from error

    def resume(self, stage: Stage) -> None:
        """Bring a stage that holds :meth:`surfels` to the checkpoint's step."""
        stage.step, stage.psnr = self.step, self.psnr
        if stage.plan.density is not None:
            stage.plan.density.restore(self.tensors, stage.surfels.device)
        if stage.exposures is not None:
            stage.exposures.restore(self.tensors)
        if stage.fused is not None:
            stage.fused.restore(self.tensors, stage.surfels.device, stage.pictured())
