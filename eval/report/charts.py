"""Charts as inline SVG that follows the page's colours: training curves, growth with size, parts of a sum."""

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

from tron.report.colours import LINE_COLOURS
from tron.report.page import Chart

INK = "#123456"
"""Stands for the page's text colour while matplotlib draws; replaced by ``currentColor`` afterwards."""
BAR_COLOURS = (*LINE_COLOURS, "#c9a227", "#5aa7a7")
CLOCK = "seconds"

Points = Sequence[tuple[float, float]]
"""(x, y) of a line, ascending in x."""


@dataclass(frozen=True)
class Curves:
    """Columns of a metrics.csv over the time of training.

    Attributes:
        columns: name -> (seconds of training, value), (n,) float64 each.
        stages: (name, seconds at which it begins), in order.
    """

    columns: dict[str, tuple[np.ndarray, np.ndarray]]
    stages: list[tuple[str, float]]


def read_metrics(path: str | Path) -> Curves:
    """Read the metrics.csv of tron-train: ``stage``, ``step``, ``seconds`` (of the stage) and figures.

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
    """One chart a kind of curve (loss, PSNR) with a line for each run's column; full frames are dashed.

    Args:
        runs: label of a run -> its metrics.csv; files that do not exist are left out.
    """
    read = {label: read_metrics(path) for label, path in runs.items() if path.is_file()}
    stages = next((curves.stages for curves in read.values()), [])
    charts = []
    for word, title in (("loss", "Loss"), ("psnr", "PSNR in dB")):
        lines = [
            (label, column, *curve, colour)
            for (label, curves), colour in zip(read.items(), LINE_COLOURS * len(read))
            for column, curve in curves.columns.items()
            if word in column.lower()
        ]
        if not lines:
            continue
        with _canvas(title) as (axes, svg):
            for label, column, x, y, colour in lines:
                style = "--" if column.endswith("_full") else "-"
                axes.plot(x, y, style, color=colour, label=f"{label}, {column}", linewidth=1.6)
            for name, begin in stages:
                axes.axvline(begin, color=INK, linewidth=0.8, linestyle=":")
                axes.annotate(
                    f" {name}", (begin, 1.0), xycoords=("data", "axes fraction"), va="top", fontsize=9
                )
            if word == "loss" and all((y > 0).all() for _, _, _, y, _ in lines):
                axes.set_yscale("log")
            axes.set(xlabel="seconds of training", ylabel=title)
        ends = "; ".join(f"{label}, {column} ends at {y[-1]:.3g}" for label, column, _, y, _ in lines)
        charts.append(Chart(svg(), f"{title} during training.", f"Line chart of {title.lower()}: {ends}."))
    return charts


def line_chart(
    lines: Mapping[str, Points],
    x_label: str,
    y_label: str,
    caption: str,
    bound: tuple[str, float] | None = None,
    logarithmic: bool = False,
) -> Chart:
    """A chart with a line for each label.

    Args:
        lines: label -> its points.
        x_label, y_label, caption: the words around it.
        bound: (name, y) of a dotted line across, such as a target.
        logarithmic: both axes are. Straight lines are powers then: where x is ten times as large and y is
            too, growth is linear. The ticks of x stand where points are.
    """
    from matplotlib.ticker import LogLocator

    with _canvas(caption) as (axes, svg):
        for (label, points), colour in zip(lines.items(), LINE_COLOURS):
            axes.plot(*zip(*points), "o-", color=colour, label=label, linewidth=1.6, markersize=3.5)
        if bound is not None:
            axes.axhline(bound[1], color=INK, linewidth=0.8, linestyle=":", label=bound[0])
        axes.set(xlabel=x_label, ylabel=y_label)
        if logarithmic:
            axes.set(xscale="log", yscale="log")
            ticks = sorted({x for points in lines.values() for x, _ in points})
            axes.set_xticks(ticks, [f"{x:,.0f}" for x in ticks])
            axes.minorticks_off()
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))  # a decade may hold them all
            axes.yaxis.set_major_formatter("{x:g}")
        else:
            axes.set_xlim(left=0)
    ends = "; ".join(
        f"{label} from {points[0][1]:.3g} to {points[-1][1]:.3g}" for label, points in lines.items()
    )
    return Chart(svg(), caption, f"Line chart, {y_label} over {x_label}: {ends}.")


def bar_chart(bars: Mapping[str, Mapping[str, float]], x_label: str, caption: str) -> Chart:
    """Horizontal bars, each a sum of parts.

    Args:
        bars: label -> part -> its length; all have the same parts, in the same order.
        x_label, caption: the words around it.
    """
    parts = list(next(iter(bars.values())))
    with _canvas(caption) as (axes, svg):
        left = np.zeros(len(bars))
        for part, colour in zip(parts, BAR_COLOURS * len(parts)):
            lengths = np.array([bar[part] for bar in bars.values()])
            axes.barh(list(bars), lengths, left=left, color=colour, label=part)
            left += lengths
        axes.invert_yaxis()  # the first on top
        axes.set(xlabel=x_label, xlim=(0, 1.25 * left.max()))  # room for the legend
    said = "; ".join(
        f"{label}: " + ", ".join(f"{part} {length:.3g}" for part, length in bar.items())
        for label, bar in bars.items()
    )
    return Chart(svg(), caption, f"Bar chart of {x_label}: {said}.")


def density_chart(clouds: Mapping[str, np.ndarray], x_label: str, y_label: str, caption: str) -> Chart:
    """Clouds of points side by side, as hexagons by how many points they hold, with the line y = x.

    Args:
        clouds: label -> (n, 2) points; all charts have the same square range.
        x_label, y_label, caption: the words around it.
    """
    from matplotlib.colors import LogNorm

    reach = max(float(np.abs(points).max(initial=0)) for points in clouds.values()) or 1.0
    reach = min(
        reach, 1.05 * max(float(np.quantile(np.abs(points), 0.999)) for points in clouds.values()) or 1.0
    )
    with _canvas(caption, columns=len(clouds), legend=False) as (axes, svg):
        for place, (label, points) in zip(np.ravel(axes), clouds.items()):
            inside = points[(np.abs(points) <= reach).all(-1)]
            place.hexbin(
                *inside.T,
                gridsize=36,
                extent=(-reach, reach, -reach, reach),
                mincnt=1,
                norm=LogNorm(),
                cmap="viridis",
                linewidths=0.2,
            )
            place.plot([-reach, reach], [-reach, reach], ":", color=INK, linewidth=0.8)
            place.set(title=label, xlabel=x_label, ylabel=y_label, aspect="equal")
    counted = "; ".join(f"{label}: {len(points):,} points" for label, points in clouds.items())
    return Chart(svg(), caption, f"Density of {y_label} over {x_label}: {counted}.")


@contextmanager
def _canvas(name: str, columns: int = 1, legend: bool = True) -> Iterator[tuple[Any, Any]]:
    """Axes in the page's style (an array of them where there are several), and a function for their SVG.

    The ink of the SVG is the page's text colour; ``name`` makes its ids its own.
    """
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
    buffer = io.StringIO()

    def svg() -> str:
        text = buffer.getvalue()
        text = text[text.index("<svg") :].replace(INK, "currentColor")
        text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
        return re.sub(r'\s(xmlns(:\w+)?|width|height)="[^"]*"', "", text, count=4)

    with rc_context(settings):
        figure = Figure(figsize=(9, 3.4), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.subplots(1, columns)
        yield axes, svg
        for each in np.ravel(axes):
            each.spines[["top", "right"]].set_visible(False)
            each.grid(alpha=0.25, color=INK)
            if legend:
                each.legend(frameon=False)
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
