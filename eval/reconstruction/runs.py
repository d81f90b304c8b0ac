"""One run of tron-reconstruct: its checked metrics.json and its wall time."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pydantic
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from eval.reconstruction.light import light_errors, read_light, sun_error_deg
from eval.reconstruction.relighting import Relit
from eval.results import Row, mean_row
from tron.errors import TronError

FIGURES = {
    "psnr": ("test_psnr", "dB"),
    "psnr_subject": ("test_psnr_subject", "dB"),
    "ssim": ("test_ssim", "1"),
    "normal_mae_deg": ("normal_mae_deg", "deg"),
    "normal_median_deg": ("normal_median_deg", "deg"),
    "base_color_psnr": ("base_color_psnr", "dB"),
    "roughness_mae": ("roughness_mae", "1"),
    "metallic_mae": ("metallic_mae", "1"),
    "metallic_wrong": ("metallic_wrong", "fraction"),
}
"""Figure of metrics.json's held-out views -> its name in the rows, and its unit."""


SUN = "sun"
"""Family of lights that have a direction."""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True)  # metrics.json says more than is read here


class Point(_Part):
    """Held-out quality during training: dB after so many seconds."""

    step: int
    seconds: FiniteFloat
    test_psnr: FiniteFloat


class Seconds(_Part):
    """Seconds of each part of a run."""

    surfels: FiniteFloat
    light: FiniteFloat = 0.0


class Views(_Part):
    """Views of a run."""

    views: int
    held_out: list[str]
    skipped: dict[str, str] = Field(default_factory=dict)


class Report(_Part):
    """Contents of metrics.json."""

    capture: Views
    surfels: int
    test: dict[str, FiniteFloat]
    train: dict[str, FiniteFloat]
    views: dict[str, dict[str, FiniteFloat]]
    seconds: Seconds
    curve: list[Point] = Field(default_factory=list)


@dataclass(frozen=True)
class Run:
    """A finished reconstruction.

    Attributes:
        name: of the scene.
        folder: output of the command.
        capture: input of the command.
        report: its metrics.json.
        seconds: wall time of the command from start to end.
        light: figure -> error of its light against the true light; empty if either is unknown.
        family: of the true light, such as "sun"; empty if unknown.
        relit: scores under other lights; None if not measured.
    """

    name: str
    folder: Path
    capture: Path
    report: Report
    seconds: float
    light: dict[str, float] = field(default_factory=dict)
    family: str = ""
    relit: Relit | None = None


def read_report(folder: Path) -> Report:
    """Read metrics.json of a finished run; TronError if it is missing or invalid."""
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


def collect_run(name: str, folder: Path, capture: Path, seconds: float) -> Run:
    """Collect a finished reconstruction; compare its light with the capture's if both are known."""
    found, truth, family = read_light(folder), read_light(capture), light_family(capture)
    light = {}
    if found is not None and truth is not None:
        light = light_errors(found, truth)
        if family == SUN:
            light["sun_direction_deg"] = sun_error_deg(found, truth)
    return Run(name, folder, capture, read_report(folder), seconds, light, family)


def light_family(capture: Path) -> str:
    """Return the family of a path-traced capture's light from its spec.json; empty if unknown."""
    try:
        return str(json.loads((capture / "spec.json").read_text("utf-8"))["lights"][0]["family"])
    except (OSError, ValueError, LookupError, TypeError):
        return ""


def rows_of(prefix: str, runs: Sequence[Run], seed: int = 0) -> Iterator[Row]:
    """Yield means over the scenes with intervals, then the figures of every scene.

    For seconds and surfels, the maximum replaces the mean and has no interval. A figure that any scene lacks
    has no mean, because the mean would be over other scenes than its neighbours. ``seed`` draws the scenes of
    the intervals.
    """
    for metric, unit, values in _figures(runs):
        if len(values) == len(runs):
            name = f"{prefix}.{metric}"
            if unit in ("s", "surfels"):
                yield Row(metric=name, value=max(values.values()), unit=unit, n=len(values))
            else:
                yield mean_row(name, unit, values.items(), seed)
        for run in runs:
            if run.name in values:
                n = 1 if unit in ("s", "surfels") else max(len(run.report.capture.held_out), 1)
                name = f"{prefix}.{metric}.{run.name.replace('-', '_')}"
                yield Row(metric=name, value=values[run.name], unit=unit, n=n)


def light_rows(prefix: str, runs: Sequence[Run], seed: int = 0) -> Iterator[Row]:
    """Yield errors of irradiance after one factor, overall and by kind of light, and of sun directions.

    All lights without a sun are soft: finding a disk in the sky is another task than finding a glow.
    """
    lit = [run for run in runs if run.light]
    sunny = [run for run in lit if run.family == SUN]
    soft = [run for run in lit if run.family != SUN]
    for name, some in (
        ("irradiance_error", lit),
        ("irradiance_error_soft", soft),
        ("irradiance_error_sun", sunny),
    ):
        if some:
            values = [(run.name, run.light["scaled_error"]) for run in some]
            yield mean_row(f"{prefix}.{name}", "fraction", values, seed)
    if sunny:
        values = [(run.name, run.light["sun_direction_deg"]) for run in sunny]
        yield mean_row(f"{prefix}.sun_direction_deg", "deg", values, seed)


def mean_curve(runs: Sequence[Run]) -> list[tuple[float, float]]:
    """Return mean (seconds, dB of held-out views) over the scenes at steps that all scenes scored."""
    by_step = [{point.step: point for point in run.report.curve} for run in runs]
    steps = sorted(set.intersection(*(set(points) for points in by_step)))
    if len(steps) < 2:
        return []
    means = [np.mean([(p[step].seconds, p[step].test_psnr) for p in by_step], axis=0) for step in steps]
    return [(float(seconds), float(psnr)) for seconds, psnr in means]


def _figures(runs: Sequence[Run]) -> Iterator[tuple[str, str, dict[str, float]]]:
    """Yield metric, unit, and scene -> value."""
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
        yield f"light.{metric}", "deg" if metric.endswith("_deg") else "fraction", values
    relit = {run.name: run.relit for run in runs if run.relit is not None}
    if relit:
        yield "relight_psnr", "dB", {name: each.psnr for name, each in relit.items()}
        for light in dict.fromkeys(light for each in relit.values() for light in each.lights):
            values = {name: each.lights[light].psnr for name, each in relit.items() if light in each.lights}
            yield f"relight_psnr_{light}", "dB", values
