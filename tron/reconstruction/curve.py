"""PSNR of held-out views as training goes: the curve that tells whether more steps would pay."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tron.captures import View
from tron.errors import TronError
from tron.metrics import capped_psnr
from tron.reconstruction.evaluation import BACKGROUND, picture, wanted_picture
from tron.reconstruction.training import Stage, StepSummary
from tron.storage import write_atomic
from tron.tracing.torch_bridge import render

_POINT = ("stage", "step", "seconds", "test_psnr", "surfels")


class Curve:
    """Scores held-out views every so many steps; kept in a file, so that a resumed run goes on with it.

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
