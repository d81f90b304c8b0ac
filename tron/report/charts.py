"""Charts by matplotlib: lines as inline SVG in a page's colours, histograms as a PNG that any page shows."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tron.report.page import Chart

LINE_COLOURS = ("#3d85c6", "#d9822b", "#4a9d5f", "#a064c8", "#c0504d", "#7f7f7f")
INK = "#123456"
"""Stands for the page's text colour while matplotlib draws; replaced by ``currentColor`` afterwards."""
Points = Sequence[tuple[float, float]]
"""(x, y) of a line, ascending in x."""
COLUMNS = 3


@dataclass(frozen=True)
class Histogram:
    """Counts of one quantity.

    Attributes:
        title: under the axis, with its unit.
        edges: (B + 1,) of the bins, ascending.
        counts: name of a distribution -> (B,) counts; where it has none of the quantity it is left out.
        logarithmic: whether the axis is.
    """

    title: str
    edges: Sequence[float]
    counts: Mapping[str, Sequence[int]]
    logarithmic: bool = False


def histograms_png(histograms: Sequence[Histogram], names: Sequence[str]) -> bytes:
    """PNG of all histograms, each distribution as shares that add up to one; the same bytes every time.

    Args:
        histograms: one panel each.
        names: of the distributions, in the order of their colours; the first is filled, the others are lines.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = -(-len(histograms) // COLUMNS)
    with rc_context({"font.family": "DejaVu Sans", "font.size": 9}):
        figure = Figure(figsize=(3.5 * COLUMNS, 2.1 * rows + 0.35), dpi=100, layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
        for panel, histogram in zip(panels, histograms):
            _draw(panel, histogram, names)
        for panel in panels[len(histograms) :]:
            panel.set_axis_off()
        handles = {
            label: handle
            for panel in panels
            for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
        }
        shown = [name for name in names if name in handles]
        figure.legend(
            [handles[name] for name in shown], shown, loc="outside upper left", ncols=4, frameon=False
        )
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _draw(panel: Any, histogram: Histogram, names: Sequence[str]) -> None:
    for number, name in enumerate(names):
        counts = np.asarray(histogram.counts.get(name, ()), np.float64)
        if not counts.sum():
            continue
        colour = LINE_COLOURS[number % len(LINE_COLOURS)]
        panel.stairs(
            counts / counts.sum(),
            histogram.edges,
            fill=number == 0,
            alpha=0.55 if number == 0 else 1.0,
            color=colour,
            linewidth=1.6,
            label=name,
        )
    panel.set_xlabel(histogram.title)
    if histogram.logarithmic:
        panel.set_xscale("log")
        panel.xaxis.set_major_formatter("{x:g}")
    panel.set_xlim(histogram.edges[0], histogram.edges[-1])
    panel.set_ylim(bottom=0)
    panel.yaxis.set_major_formatter("{x:.0%}")
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(alpha=0.25)


def line_chart(
    lines: Mapping[str, Points],
    x_label: str,
    y_label: str,
    caption: str,
    bound: tuple[str, float] | None = None,
    logarithmic: bool = False,
) -> Chart:
    """A chart with a line for each label: SVG in the page's text colour, the same bytes every time.

    Args:
        lines: label -> its points.
        x_label, y_label, caption: the words around it.
        bound: (name, y) of a dotted line across, such as a target.
        logarithmic: both axes are. Straight lines are powers then: where x is ten times as large and y is
            too, growth is linear. The ticks of x stand where points are.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    settings: dict[Any, Any] = {
        "svg.fonttype": "none",  # text stays text: selectable, in the page's font
        "svg.hashsalt": caption,  # ids that differ between charts
        "font.family": "sans-serif",
        "font.size": 10,
        **{f"{part}.color": INK for part in ("text", "xtick", "ytick")},
        "axes.edgecolor": INK,
        "axes.labelcolor": INK,
    }
    buffer = io.StringIO()
    with rc_context(settings):
        figure = Figure(figsize=(9, 3.4), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.subplots()
        for number, (label, points) in enumerate(lines.items()):
            colour = LINE_COLOURS[number % len(LINE_COLOURS)]
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
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, color=INK)
        axes.legend(frameon=False)
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    svg = re.sub(r'\s(xmlns(:\w+)?|width|height)="[^"]*"', "", text, count=4)
    ends = "; ".join(
        f"{label} from {points[0][1]:.3g} to {points[-1][1]:.3g}" for label, points in lines.items()
    )
    return Chart(svg, caption, f"Line chart, {y_label} over {x_label}: {ends}.")
