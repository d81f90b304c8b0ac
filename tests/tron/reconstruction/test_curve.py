"""Laws of the curve: held-out views in plain PSNR, points that a resumed run would repeat are dropped."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tron.apps.reconstruct.run import Curve
from tron.errors import TronError
from tron.reconstruction.geometry.surfels import LearntSurfels
from tron.reconstruction.geometry.training import Stage, StepSummary, materials_plan, radiance_plan
from tron.reconstruction.scores import mean_figures, score_views
from tron.reconstruction.settings import DensitySettings, MaterialSettings, RadianceSettings
from tron.tracing import SurfelTracer


@pytest.fixture
def stage(painted, painted_capture) -> Stage:
    settings = RadianceSettings(steps=5, density=DensitySettings(start=1000), sh_every=1)
    plan = radiance_plan(settings, 1.0, 0)
    # Some 26 dB from the truth: at 52 dB rounding alone is a tenth of a decibel.
    off = replace(painted, sh=painted.sh + np.float32(0.2))
    return Stage(plan, painted_capture.train_views, LearntSurfels.of_scene(off, plan.rates), 2, 0)


def progress(step: int, steps: int = 100, stage: str = "radiance", seconds: float = 0.5) -> StepSummary:
    return StepSummary(stage, step, steps, 0.1, 20.0, 600, seconds)


def test_points_come_every_so_many_steps_and_at_the_end(stage, painted_capture, tmp_path: Path) -> None:
    curve = Curve(tmp_path / "curve.json", painted_capture.test_views, every=2)
    stage.run(curve.watch)
    assert [point["step"] for point in curve.points] == [2, 4, 5]
    assert json.loads((tmp_path / "curve.json").read_text()) == curve.points
    seconds = [point["seconds"] for point in curve.points]
    assert seconds == sorted(seconds)
    assert all(point["surfels"] == 600 and point["stage"] == "radiance" for point in curve.points)
    scores = score_views(SurfelTracer(stage.surfels.scene(2, np.array([0.0, 0, 1]))), curve.views)
    assert curve.points[-1]["test_psnr"] == pytest.approx(mean_figures(scores)["psnr"], abs=0.01)


def test_the_seconds_are_those_of_the_steps_alone(stage, painted_capture, tmp_path, monkeypatch) -> None:
    """Set-up, scores and what lies between steps move the clock and take no part."""
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    curve = Curve(tmp_path / "curve.json", painted_capture.test_views, every=2)
    now[0] += 1000  # priors, initial surfels

    def slow(_: Stage) -> float:
        now[0] += 100
        return 20.0

    advance = stage.advance

    def step() -> StepSummary:
        now[0] += 10  # a checkpoint
        return advance()

    def targets(*arguments):
        now[0] += 1
        return found(*arguments)

    from tron.reconstruction.geometry import training

    found = training.targets
    monkeypatch.setattr(training, "targets", targets)
    monkeypatch.setattr(stage, "advance", step)
    monkeypatch.setattr(curve, "_score", slow)
    stage.run(curve.watch)
    assert [point["seconds"] for point in curve.points] == [2, 4, 5]


def test_a_resumed_run_drops_the_points_after_its_checkpoint(stage, painted_capture, tmp_path) -> None:
    path, views = tmp_path / "curve.json", painted_capture.test_views
    curve = Curve(path, views, every=10)
    for step in (10, 20, 30, 40):
        curve.watch(progress(step), stage)
    before = curve.points
    again = Curve(path, views, every=10)  # the checkpoint was at step 25
    for step in range(26, 41):
        again.watch(progress(step), stage)
    assert [point["step"] for point in again.points] == [10, 20, 30, 40]
    assert again.points[:2] == before[:2]
    assert again.points[2]["seconds"] >= before[1]["seconds"]
    anew = Curve(path, views, every=10)  # killed before its first checkpoint
    anew.watch(progress(1), stage)
    assert anew.points == []


def test_only_stages_that_compare_pictures_are_scored(stage, painted, painted_capture, tmp_path) -> None:
    path = tmp_path / "curve.json"
    curve = Curve(path, painted_capture.test_views, every=10)
    curve.watch(progress(10), stage)
    plan = materials_plan(MaterialSettings(steps=20))
    second = Stage(plan, painted_capture.train_views, LearntSurfels.of_scene(painted, plan.rates), 2, 0)
    again = Curve(path, painted_capture.test_views, every=10)
    for each in (curve, again):
        each.watch(progress(10, stage="materials"), second)
        assert [(point["stage"], point["step"]) for point in each.points] == [("radiance", 10)]


@pytest.mark.parametrize("content", ["", "[", "3", "[1]", "[{}]", '{"a": 1}', '[{"stage": "radiance"}]'])
def test_a_file_that_is_no_curve_is_one_line(painted_capture, tmp_path: Path, content: str) -> None:
    path = tmp_path / "curve.json"
    path.write_text(content)
    with pytest.raises(TronError, match="not a curve") as caught:
        Curve(path, painted_capture.test_views, every=1)
    assert "\n" not in str(caught.value)
