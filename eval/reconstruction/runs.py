"""What one run of tron-reconstruct left behind: its metrics.json, read and checked, and the time it took."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pydantic
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from eval.results import Row, mean_row
from tron.errors import TronError

FIGURES = {
    "psnr": ("test_psnr", "dB"),
    "psnr_subject": ("test_psnr_subject", "dB"),
    "ssim": ("test_ssim", "1"),
    "normal_mae_deg": ("normal_mae_deg", "deg"),
    "base_color_psnr": ("base_color_psnr", "dB"),
    "roughness_mae": ("roughness_mae", "1"),
    "metallic_mae": ("metallic_mae", "1"),
}
"""Figure of metrics.json's held-out views -> how the rows call it, and its unit."""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True)  # metrics.json says more than is read here


class Point(_Part):
    """Held-out quality under way: dB after so many seconds of training, with so many surfels."""

    stage: str
    step: int
    seconds: FiniteFloat
    test_psnr: FiniteFloat
    surfels: int


class Seconds(_Part):
    """Seconds of the parts of a run."""

    surfels: FiniteFloat
    light: FiniteFloat = 0.0


class Views(_Part):
    """Which views there were."""

    views: int
    held_out: list[str]
    skipped: dict[str, str] = Field(default_factory=dict)


class Report(_Part):
    """metrics.json."""

    capture: Views
    surfels: int
    materials_learnt: list[str] = Field(default_factory=list)
    test: dict[str, FiniteFloat]
    train: dict[str, FiniteFloat]
    views: dict[str, dict[str, FiniteFloat]]
    seconds: Seconds
    curve: list[Point] = Field(default_factory=list)


@dataclass(frozen=True)
class Run:
    """A finished reconstruction.

    Attributes:
        name: of the scene. folder: what the command wrote. capture: what it read.
        report: its metrics.json. seconds: wall time of the command from start to end.
        light: figures of its light against the true one, name -> value; empty where either is unknown.
        family: of the true light, such as "sun"; empty if unknown.
    """

    name: str
    folder: Path
    capture: Path
    report: Report
    seconds: float
    light: dict[str, float] = field(default_factory=dict)
    family: str = ""

    def curve(self) -> list[tuple[float, float]]:
        """(seconds of training, dB) of held-out views."""
        return [(point.seconds, point.test_psnr) for point in self.report.curve]


def read_report(folder: Path) -> Report:
    """metrics.json of a finished run; TronError if it is missing, or is none."""
    path = folder / "metrics.json"
    try:
        return Report.model_validate_json(path.read_bytes())
    except OSError as error:
        raise TronError(
            f"cannot read: {error.strerror or error}", path, "delete it all to redo it"
        ) from error
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "file"
        raise TronError(f"not tron-reconstruct's metrics: {place}: {first['msg']}", path) from error


def light_family(capture: Path) -> str:
    """What kind of light a path-traced capture stands in, as its spec.json says; empty where none says so."""
    try:
        return str(json.loads((capture / "spec.json").read_text("utf-8"))["lights"][0]["family"])
    except (OSError, ValueError, LookupError, TypeError):
        return ""


def rows_of(prefix: str, runs: Sequence[Run], seed: int = 0) -> Iterator[Row]:
    """Means over the scenes with intervals (of seconds and surfels the most, which has none), then every
    scene's own figures. ``seed`` draws the scenes of the intervals.

    A figure that a scene lacks has no row for it, and no mean, which would be of other scenes than its
    neighbours are.
    """
    for metric, unit, values in _figures(runs):
        if len(values) == len(runs):
            name = f"{prefix}.{metric}"
            if unit in ("s", "surfels"):
                yield Row(metric=name, value=max(values.values()), unit=unit, n=len(values))
            else:
                yield mean_row(name, unit, [*values], [*values.values()], seed)
        for run in runs:
            if run.name in values:
                n = 1 if unit in ("s", "surfels") else max(len(run.report.capture.held_out), 1)
                name = f"{prefix}.{metric}.{run.name.replace('-', '_')}"
                yield Row(metric=name, value=values[run.name], unit=unit, n=n)


def _figures(runs: Sequence[Run]) -> Iterator[tuple[str, str, dict[str, float]]]:
    """Metric, unit, scene -> value."""
    for key, (metric, unit) in FIGURES.items():
        values = {run.name: run.report.test[key] for run in runs if key in run.report.test}
        if values:
            yield metric, unit, values
    yield "train_psnr", "dB", {run.name: run.report.train["psnr"] for run in runs}
    yield "surfels", "surfels", {run.name: float(run.report.surfels) for run in runs}
    yield "seconds", "s", {run.name: run.seconds for run in runs}
    yield "surfels_seconds", "s", {run.name: run.report.seconds.surfels for run in runs}
    yield "light_seconds", "s", {run.name: run.report.seconds.light for run in runs}
    for metric in dict.fromkeys(name for run in runs for name in run.light):
        values = {run.name: run.light[metric] for run in runs if metric in run.light}
        yield f"light.{metric}", "fraction", values
