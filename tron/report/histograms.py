"""Histograms beside one another as a PNG that any page shows: several distributions of each quantity."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tron.report.colours import LINE_COLOURS

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
