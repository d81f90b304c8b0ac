"""One run of tron-reconstruct: surfels, light, scores, pictures, and the report of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import tron
from tron.apps.reconstruct.pictures import write_light, write_sheet
from tron.apps.reconstruct.report import write_page
from tron.apps.reconstruct.settings import Settings
from tron.apps.reconstruct.splat_capture import is_splats
from tron.captures import Capture, View
from tron.captures.capture import content_hash
from tron.captures.coverage import seen_from_deg
from tron.cli.progress import Progress, track, working
from tron.errors import TronError
from tron.metrics import LPIPS, capped_psnr
from tron.reconstruction import Prior, Reconstruction, reconstruct
from tron.reconstruction.geometry.training import Stage, StepSummary
from tron.reconstruction.scores import BACKGROUND, mean_figures, picture, wanted_picture
from tron.runtime import describe_machine
from tron.scans.camera_files import write_cameras
from tron.storage import write_atomic
from tron.tracing.torch_bridge import render

CHECKPOINT = "checkpoint.safetensors"
PAGE = "report.html"
_POINT = ("stage", "step", "seconds", "test_psnr", "surfels")


def run(settings: Settings, capture: Capture, prior: Prior, lpips: LPIPS | None) -> dict[str, Any]:
    """Reconstruct a capture into the output folder; the report, which metrics.json holds.

    Args:
        settings: of the command.
        capture: as it was read.
        prior: of normals, materials and irradiance.
        lpips: scores LPIPS as well.
    """
    out = settings.output_dir
    bars = StageBars("first surfels" if capture.scan is None else "materials and light of the scan")
    curve = None
    if settings.score_every and capture.test:
        curve = Curve(out / "curve.json", capture.test_views, settings.score_every)

    def watch(progress: StepSummary, stage: Stage) -> None:
        bars.watch(progress)
        if curve is not None:
            curve.watch(progress, stage)

    try:
        found = reconstruct(
            capture, prior, settings.of_surfels(), light=settings.light, checkpoint=out / CHECKPOINT,
            lpips=lpips, watch=watch, track=track,
        )  # fmt: skip
    finally:
        bars.close()
    found.scene.save(out / "scene.ply")
    write_cameras(out, capture.views, capture.offset)
    environment = None if found.light is None else found.light.environment
    if environment is not None:
        environment.save(out / "environment.exr")
    called = "filmed view" if is_splats(settings.capture) else "photo"
    with working("contact sheet"):
        write_sheet(
            out / "contact_sheet.png", found.scene, capture, environment, settings.light, called, found.proxy
        )
        if environment is not None:
            write_light(out / "light.png", environment)
    report = _report(settings, capture, found)
    if curve is not None:
        report["curve"] = curve.points
    if settings.report is not None:
        with working("report"):
            write_page(
                out / PAGE, settings.report, report, found.scene, capture, environment, called, found.proxy
            )
    write_atomic(out / "metrics.json", json.dumps(report, indent=1, allow_nan=False) + "\n")
    return report


def shown_by(capture: Capture) -> list[str]:
    """Hashes of what training and held-out views show, by which a capture is known again."""
    return [capture.content, content_hash(capture.test_views)]


class StageBars:
    """A bar for each stage as it comes, and a name for what lies before and between them."""

    def __init__(self, first: str = "first surfels") -> None:
        self._stage = ""
        self._bar: Progress | None = working(first)

    def watch(self, progress: StepSummary) -> None:
        """Show a step."""
        if progress.stage != self._stage:
            self.close()
            self._stage = progress.stage
            self._bar = Progress(progress.stage, progress.steps, progress.step - 1, "steps")
        if self._bar is not None:
            quality = "" if np.isnan(progress.psnr) else f"{progress.psnr:.1f} dB, "
            self._bar.update(progress.step, f"{quality}{progress.surfels:,} surfels")
        if progress.step == progress.steps:
            self.close()
            self._bar = working("light and materials") if progress.stage == "radiance" else None

    def close(self) -> None:
        """Leave the last bar as it is."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class Curve:
    """PSNR of held-out views every so many steps; kept in a file, so that a resumed run goes on with it.

    Args:
        path: JSON file.
        views: scored; none of them is learnt from.
        every: steps between two scores.

    Attributes:
        points: stage, step, seconds (of the steps up to here, as :class:`StepSummary` has them: neither
            set-up, scores nor checkpoints), test_psnr (dB), surfels.

    Raises:
        TronError: the file holds no curve.
    """

    def __init__(self, path: Path, views: Sequence[View], every: int) -> None:
        self.path, self.views, self.every = path, views, every
        self.points: list[dict[str, Any]] = []
        if path.exists():
            try:
                points = json.loads(path.read_text("utf-8"))
                self.points = [{name: point[name] for name in _POINT} for point in points]
            except (ValueError, TypeError, KeyError) as error:
                raise TronError(f"not a curve: {error}", path, "remove it") from error
        self._seconds: float | None = None

    def watch(self, progress: StepSummary, stage: Stage) -> None:
        """Take note of a step."""
        if self._seconds is None:
            self._seconds = self._begin(progress)
        self._seconds += progress.seconds
        if stage.plan.weights.rgb and (progress.step % self.every == 0 or progress.step == progress.steps):
            self.points.append(
                {
                    "stage": progress.stage,
                    "step": progress.step,
                    "seconds": round(self._seconds, 2),
                    "test_psnr": round(self._score(stage), 3),
                    "surfels": progress.surfels,
                }
            )
            write_atomic(self.path, json.dumps(self.points, indent=1) + "\n")

    def _begin(self, progress: StepSummary) -> float:
        """Forget what was scored after the checkpoint that the run goes on from; the seconds until there."""
        self.points = [p for p in self.points if p["stage"] != progress.stage or p["step"] < progress.step]
        return self.points[-1]["seconds"] if self.points else 0.0

    def _score(self, stage: Stage) -> float:
        behind = BACKGROUND[stage.plan.background]
        scores = []
        with torch.no_grad():
            surfels = stage.surfels.rendered()
            for view in self.views:
                rendered = render(
                    surfels, view.camera, kernel_degree=stage.kernel_degree, sh_degree=stage.sh_degree
                )
                buffers = {name: rendered[name].cpu().numpy() for name in ("rgb", "opacity")}
                scores.append(capped_psnr(picture(buffers, behind), wanted_picture(view, behind)))
        return float(np.mean(scores))


def _report(settings: Settings, capture: Capture, found: Reconstruction) -> dict[str, Any]:
    test, train = found.scores["test"], found.scores["train"]
    return {
        "version": tron.__version__,
        "capture": {
            "path": str(settings.capture),
            "views": len(capture.views),
            "held_out": sorted(capture.test),
            "skipped": dict(capture.skipped),
            "up": capture.up.tolist(),
            "seen_from_deg": seen_from_deg(capture.train_cameras, capture.up),
            "transform": capture.transform.tolist(),
            "offset": capture.offset.tolist(),
            "content": shown_by(capture),
        },
        "surfels": len(found.scene),
        "first_surfels": {"source": found.source, "stereo_confident": found.confident},
        "opened": found.opened,
        "materials_learnt": list(found.learnt),
        "test": mean_figures(test) if test else None,
        "train": mean_figures(train),
        "views": {score.view: dict(score.figures) for score in (*test, *train)},
        "albedo_scaling": "per view and channel, least squares on the subject",
        "light": None if found.light is None else found.light.said,
        "seconds": {name: round(value, 2) for name, value in found.seconds.items()},
        "settings": settings.kept(),
        "machine": describe_machine(),
    }
