"""One run of tron-reconstruct: surfels, light, scores, pictures, and the report of them."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

import tron
from tron.apps.filmed_space import write_cameras
from tron.apps.reconstruct_pictures import write_light, write_sheet
from tron.apps.reconstruct_report import write_page
from tron.apps.reconstruct_settings import Settings
from tron.captures import Capture
from tron.captures.content import content_hash
from tron.cli.progress import Progress, track
from tron.metrics import LPIPS
from tron.priors import Prior
from tron.reconstruction import Joint, Reconstruction, fit_environment, reconstruct
from tron.reconstruction.curve import Curve
from tron.reconstruction.evaluation import ViewScore, mean_figures, score_views
from tron.reconstruction.training import Stage, StepSummary
from tron.runtime import describe_machine, torch_device
from tron.storage import write_atomic
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

CHECKPOINT = "checkpoint.safetensors"
PAGE = "report.html"
TRAIN_VIEWS_SCORED = 8


def run(settings: Settings, capture: Capture, prior: Prior | Joint, lpips: LPIPS | None) -> dict[str, Any]:
    """Reconstruct a capture into the output folder; the report, which metrics.json holds.

    Args:
        settings: of the command.
        capture: as it was read.
        prior: of normals, materials and irradiance.
        lpips: scores LPIPS as well.
    """
    out = settings.output_dir
    bars = StageBars()
    curve = None
    if settings.score_every and capture.test:
        curve = Curve(out / "curve.json", capture.test_views, settings.score_every)

    def watch(progress: StepSummary, stage: Stage) -> None:
        bars.watch(progress)
        if curve is not None:
            curve.watch(progress, stage)

    try:
        found = reconstruct(
            capture, prior, settings.of_surfels(),
            checkpoint=out / CHECKPOINT, device=torch_device(settings.variant), watch=watch, track=track,
        )  # fmt: skip
    finally:
        bars.close()
    found.scene.save(out / "scene.ply")
    write_cameras(out, capture.views)
    tracer = SurfelTracer(found.scene)
    started = time.perf_counter()
    environment, said = None, None
    if settings.light is None:
        log.info("no light is fitted: light=null")
    elif found.explanation is not None:
        environment, said = found.explanation.environment, found.explanation.said()
    elif isinstance(prior, Joint):
        pass  # too few surfels are seen, as was told
    elif not any(view.has("irradiance") for view in found.capture.train_views):
        log.warning("the prior gives no irradiance, so no light can be fitted: there is no environment.exr")
    else:
        light = fit_environment(found.capture, tracer, settings.light, track)
        environment = light.environment
        said = {"sigma": light.scale.sigma, "irradiance_l1": float(np.mean(light.cubemap.loss[-50:]))}
    if environment is not None:
        environment.save(out / "environment.exr")
    seconds = {"surfels": round(found.seconds, 2), "light": round(time.perf_counter() - started, 2)}
    background = settings.radiance.background
    test = score_views(tracer, capture.test_views, background, lpips, track)
    some = capture.train_views[:: max(1, len(capture.train_views) // TRAIN_VIEWS_SCORED)]
    train = score_views(tracer, some, background, lpips, track)
    write_sheet(out / "contact_sheet.png", tracer, capture, environment, settings.light)
    if environment is not None:
        write_light(out / "light.png", environment)
    report = _report(settings, capture, found, said, test, train, seconds)
    if curve is not None:
        report["curve"] = curve.points
    if settings.report is not None:
        write_page(out / PAGE, settings.report, report, found.scene, capture, environment)
    write_atomic(out / "metrics.json", json.dumps(report, indent=1, allow_nan=False) + "\n")
    return report


def shown_by(capture: Capture) -> list[str]:
    """Hashes of what training and held-out views show, by which a capture is known again."""
    return [capture.content, content_hash(capture.test_views)]


class StageBars:
    """A bar for each stage as it comes."""

    def __init__(self) -> None:
        self._stage, self._bar = "", None

    def watch(self, progress: StepSummary) -> None:
        """Show a step."""
        if progress.stage != self._stage:
            self.close()
            self._stage = progress.stage
            self._bar = Progress(progress.stage, progress.steps, progress.step - 1, "steps")
        if self._bar is not None:
            quality = "" if np.isnan(progress.psnr) else f"{progress.psnr:.1f} dB, "
            self._bar.update(progress.step, f"{quality}{progress.surfels:,} surfels")

    def close(self) -> None:
        """Leave the last bar as it is."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def _report(
    settings: Settings,
    capture: Capture,
    found: Reconstruction,
    light: dict[str, Any] | None,
    test: Sequence[ViewScore],
    train: Sequence[ViewScore],
    seconds: dict[str, float],
) -> dict[str, Any]:
    return {
        "version": tron.__version__,
        "capture": {
            "path": str(settings.capture),
            "views": len(capture.views),
            "held_out": sorted(capture.test),
            "skipped": dict(capture.skipped),
            "up": capture.up.tolist(),
            "transform": capture.transform.tolist(),
            "content": shown_by(capture),
        },
        "surfels": len(found.scene),
        "first_surfels": {"source": found.source, "stereo_confident": found.confident},
        "materials_learnt": list(found.learnt),
        "test": mean_figures(test) if test else None,
        "train": mean_figures(train),
        "views": {score.view: dict(score.figures) for score in (*test, *train)},
        "albedo_scaling": "per view and channel, least squares on the subject",
        "light": light,
        "seconds": seconds,
        "settings": settings.kept(),
        "machine": describe_machine(),
    }
