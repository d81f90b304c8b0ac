"""Training curves as inline SVG that follows the page's colours."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eval.report.page import Chart

INK = "#123456"
"""Stands for the page's text colour while matplotlib draws; replaced by ``currentColor`` afterwards."""
LINE_COLOURS = ("#3d85c6", "#d9822b", "#4a9d5f", "#a064c8", "#c0504d", "#7f7f7f")
CLOCK = "seconds"


@dataclass(frozen=True)
class Curves:
    """What a metrics.csv holds: column -> (seconds of training, value), (n,) float64 each, and where stages
    begin.

    ``stages`` are (name, seconds at which it begins), in order.
    """

    columns: dict[str, tuple[np.ndarray, np.ndarray]]
    stages: list[tuple[str, float]]


def read_metrics(path: str | Path) -> Curves:
    """Read the metrics.csv of tron-train: ``stage``, ``step``, ``seconds`` (of the stage) and columns of
    figures.

    The stages' clocks are put one behind the other. A value that is only repeated (a validation's, until the
    next) stands once, where it is new. Columns without two numbers are left out, and so is a file without a
    clock.
    """
    with open(path, newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if np.isfinite(_number(row.get(CLOCK)))]
    seconds, stages, offset, last = [], [], 0.0, 0.0
    for row in rows:
        if not stages or row.get("stage", "") != stages[-1][0]:
            offset += last
            stages.append((row.get("stage", ""), offset))
        last = _number(row[CLOCK])
        seconds.append(offset + last)
    columns = {}
    for column in rows[0] if rows else ():
        values = np.array([_number(row[column]) for row in rows])
        fresh = np.isfinite(values) & np.append(True, values[1:] != values[:-1])
        if column not in ("stage", "step", CLOCK) and fresh.sum() > 1:
            columns[column] = (np.array(seconds)[fresh], values[fresh])
    return Curves(columns, stages)


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return float("nan")


def training_curves(runs: Mapping[str, Path]) -> list[Chart]:
    """One chart a kind of curve (loss, PSNR) with a line for each run's column.

    Args:
        runs: label of a run -> its metrics.csv; files that do not exist are left out.
    """
    read = {label: read_metrics(path) for label, path in runs.items() if path.is_file()}
    lines = [
        (f"{label}, {column}", *curve)
        for label, curves in read.items()
        for column, curve in curves.columns.items()
    ]
    stages = next((curves.stages for curves in read.values()), [])
    charts = []
    for word, title in (("loss", "Loss"), ("psnr", "PSNR in dB")):
        chosen = [line for line in lines if word in line[0].lower()]
        if chosen:
            ends = "; ".join(f"{label} ends at {y[-1]:.3g}" for label, _, y in chosen)
            svg = _draw(
                chosen, stages, title, logarithmic=word == "loss" and all((y > 0).all() for *_, y in chosen)
            )
            charts.append(Chart(svg, f"{title} during training.", f"Line chart of {title.lower()}: {ends}."))
    return charts


def _draw(
    lines: list[tuple[str, np.ndarray, np.ndarray]],
    stages: list[tuple[str, float]],
    title: str,
    logarithmic: bool,
) -> str:
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    settings: dict[Any, Any] = {
        "svg.fonttype": "none",  # text stays text: selectable, in the page's font
        "svg.hashsalt": title,  # the same bytes every time, and ids that differ between charts
        "font.family": "sans-serif",
        "font.size": 10,
        **{f"{name}.color": INK for name in ("text", "xtick", "ytick")},
        "axes.edgecolor": INK,
        "axes.labelcolor": INK,
    }
    with rc_context(settings):
        figure = Figure(figsize=(9, 3.4), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.add_subplot()
        runs = list(dict.fromkeys(label.partition(",")[0] for label, *_ in lines))
        for label, x, y in lines:
            colour = LINE_COLOURS[runs.index(label.partition(",")[0]) % len(LINE_COLOURS)]
            style = "--" if label.endswith("_full") else "-"
            axes.plot(x, y, style, color=colour, label=label, linewidth=1.6)
        for name, begin in stages:
            axes.axvline(begin, color=INK, linewidth=0.8, linestyle=":")
            axes.annotate(f" {name}", (begin, 1.0), xycoords=("data", "axes fraction"), va="top", fontsize=9)
        if logarithmic:
            axes.set_yscale("log")
        axes.set_xlabel("seconds of training")
        axes.set_ylabel(title)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, color=INK)
        axes.legend(frameon=False)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(INK, "currentColor")
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    return re.sub(r'\s(xmlns(:\w+)?|width|height)="[^"]*"', "", svg, count=4)
