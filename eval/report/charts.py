"""Line charts as inline SVG that follows the page's colours: training curves, growth of time with size."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
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
    with _canvas(title) as (figure, axes):
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
        return _finished(figure, axes)


def growth_chart(
    lines: Mapping[str, Sequence[tuple[float, float]]], x_label: str, y_label: str, caption: str
) -> Chart:
    """A chart with both axes logarithmic; ``lines`` maps a label to its (x, y) points, ascending in x.

    Straight lines are powers: where x is ten times as large and y is too, growth is linear.
    """
    from matplotlib.ticker import LogLocator

    with _canvas(caption) as (figure, axes):
        for (label, points), colour in zip(lines.items(), LINE_COLOURS):
            x, y = zip(*points)
            axes.plot(x, y, "o-", color=colour, label=label, linewidth=1.6, markersize=4)
        axes.set_xscale("log")
        axes.set_yscale("log")
        ticks = sorted({x for points in lines.values() for x, _ in points})
        axes.set_xticks(ticks, [f"{x:,.0f}" for x in ticks])
        axes.minorticks_off()
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))  # a decade may hold them all
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        svg = _finished(figure, axes)
    ends = "; ".join(
        f"{label} from {points[0][1]:.3g} to {points[-1][1]:.3g}" for label, points in lines.items()
    )
    return Chart(svg, caption, f"Line chart, {y_label} over {x_label}: {ends}.")


def progress_chart(
    lines: Mapping[str, Sequence[tuple[float, float]]],
    x_label: str,
    y_label: str,
    caption: str,
    bound: tuple[str, float] | None = None,
) -> Chart:
    """A chart with both axes linear; ``lines`` maps a label to its (x, y) points, ascending in x.

    ``bound`` is (name, y) of a dotted line across, such as a target.
    """
    with _canvas(caption) as (figure, axes):
        for (label, points), colour in zip(lines.items(), LINE_COLOURS):
            x, y = zip(*points)
            axes.plot(x, y, "o-", color=colour, label=label, linewidth=1.6, markersize=3)
        if bound is not None:
            name, height = bound
            axes.axhline(height, color=INK, linewidth=0.8, linestyle=":", label=name)
        axes.set_xlim(left=0)
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        svg = _finished(figure, axes)
    ends = "; ".join(f"{label} ends at {points[-1][1]:.3g}" for label, points in lines.items())
    return Chart(svg, caption, f"Line chart, {y_label} over {x_label}: {ends}.")


@contextmanager
def _canvas(name: str) -> Iterator[tuple[Any, Any]]:
    """A figure and its axes in the page's style; ``name`` makes the chart's ids its own."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    settings: dict[Any, Any] = {
        "svg.fonttype": "none",  # text stays text: selectable, in the page's font
        "svg.hashsalt": name,  # the same bytes every time, and ids that differ between charts
        "font.family": "sans-serif",
        "font.size": 10,
        **{f"{part}.color": INK for part in ("text", "xtick", "ytick")},
        "axes.edgecolor": INK,
        "axes.labelcolor": INK,
    }
    with rc_context(settings):
        figure = Figure(figsize=(9, 3.4), layout="constrained")
        FigureCanvasSVG(figure)
        yield figure, figure.add_subplot()


def _finished(figure: Any, axes: Any) -> str:
    """The figure as SVG whose ink is the page's text colour."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, color=INK)
    axes.legend(frameon=False)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(INK, "currentColor")
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    return re.sub(r'\s(xmlns(:\w+)?|width|height)="[^"]*"', "", svg, count=4)
