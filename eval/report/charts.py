"""Training curves as inline SVG that follows the page's colours."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from eval.report.page import Chart

INK = "#123456"
"""Stands for the page's text colour while matplotlib draws; replaced by ``currentColor`` afterwards."""
LINE_COLOURS = ("#3d85c6", "#d9822b", "#4a9d5f", "#a064c8", "#c0504d", "#7f7f7f")
CLOCKS = ("seconds", "elapsed", "step")
"""Columns that may serve as the horizontal axis, the first that exists."""


def read_metrics(path: str | Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Curves of a metrics.csv: column -> (clock, value), each (n,) float64, without the rows that lack it.

    The first line names the columns; ``step`` (or ``seconds``) is the clock. Columns that are not numbers
    are left out, and so is a file without a clock.
    """
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    clock = next((name for name in CLOCKS if rows and name in rows[0]), None)
    if clock is None:
        return {}
    curves = {}
    for column in rows[0]:
        if column in (*CLOCKS, "epoch"):
            continue
        points = [(_number(row[clock]), _number(row[column])) for row in rows]
        kept = np.array([point for point in points if np.isfinite(point).all()])
        if len(kept) > 1:
            curves[column] = (kept[:, 0], kept[:, 1])
    return curves


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
    lines = [
        (f"{label} {column}", *curve)
        for label, path in runs.items()
        if path.is_file()
        for column, curve in read_metrics(path).items()
    ]
    charts = []
    for word, title in (("loss", "Loss"), ("psnr", "PSNR in dB")):
        chosen = [line for line in lines if word in line[0].lower()]
        if chosen:
            ends = "; ".join(f"{label} ends at {y[-1]:.3g}" for label, _, y in chosen)
            svg = _draw(chosen, title, logarithmic=word == "loss" and all((y > 0).all() for *_, y in chosen))
            charts.append(Chart(svg, f"{title} during training.", f"Line chart of {title.lower()}: {ends}."))
    return charts


def _draw(lines: list[tuple[str, np.ndarray, np.ndarray]], title: str, logarithmic: bool) -> str:
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
        for k, (label, x, y) in enumerate(lines):
            colour = LINE_COLOURS[k % len(LINE_COLOURS)]
            style = "-" if len(x) > 30 or k < len(LINE_COLOURS) else "--"
            axes.plot(x, y, style, color=colour, label=label, linewidth=1.6)
        if logarithmic:
            axes.set_yscale("log")
        axes.set_xlabel("optimiser step")
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
