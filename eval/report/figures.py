"""Text of figures, verdicts and intervals, for tables, tiles, sentences and the terminal."""

from __future__ import annotations

import re
from pathlib import Path

from rich.console import Console
from rich.table import Column, Table

from eval.confidence import LEAST, LEVEL
from eval.results import Results, Row, Target
from tron.report.page import Cell, Tone, format_value, suffix

FEW = 8
"""Scenes under which an interval is said to be wide; from so many on it holds nearly what it claims."""


def with_interval(row: Row, signed: bool | None = None) -> str:
    """Format a row's figure with its unit and its interval over scenes: ``34.10 dB [32.85, 35.20]``.

    Intervals over fewer than LEAST scenes stay in results.json. Gains have a sign, unless ``signed`` says
    otherwise.
    """
    if signed is None:
        signed = "gain" in row.metric and row.unit == "dB"
    figure = format_value(row.value, row.unit, signed)
    if row.low is None or row.high is None or (row.scenes or 0) < LEAST:
        return figure
    unit = suffix(row.unit)
    low, high = (format_value(end, row.unit, signed).removesuffix(unit) for end in (row.low, row.high))
    return f"{figure} [{low}, {high}]"


def left_out(row: Row) -> str:
    """Describe the range of a gain with one scene left out; empty if not measured."""
    if row.without_one is None:
        return ""
    low, high = (format_value(end, row.unit, signed=True) for end in row.without_one)
    return f"{low} to {high} without any one scene"


def row_cell(row: Row | None, tone: Tone = "plain") -> Cell:
    """Return a row's figure and interval as a cell, a dash if not measured.

    A gain in dB is good or bad where its interval says so.
    """
    if row is None:
        return Cell("—", tone)
    if "gain" in row.metric and row.unit == "dB":
        sure = row.low is None or row.high is None or not row.low <= 0 <= row.high
        tone = tone if not (sure and row.value) else "good" if row.value > 0 else "bad"
    return Cell(with_interval(row), tone)


def verdict(target: Target, measured: float | None, unit: str) -> tuple[str, Tone]:
    """Return the verdict on a target in words, with its tone: reached or missed, and by how much."""
    if measured is None:
        return "not measured", "plain"
    margin = target.margin(measured)
    amount = format_value(abs(margin), unit) if unit != "s" else f"{abs(margin):.0f} s"
    if target.reached(measured):
        return f"reached, {amount} to spare", "good"
    return f"missed by {amount}", "bad"


def bound(target: Target, unit: str) -> str:
    """Format a bound: ``at least 3.00 dB``; without a unit, if nothing was measured, ``at least 3``."""
    return f"{target.bound} {format_value(target.value, unit) if unit else f'{target.value:g}'}"


def interval_note(scenes: int, observed: str = "") -> str:
    """Return a note on the brackets of means over so many scenes.

    ``observed`` names what else was averaged over, such as "60 frames".
    """
    counted = f"{observed} are {scenes} independent scenes" if observed else f"There are {scenes} scenes"
    if scenes < 2:
        return "One scene does not say how much another would differ: no interval is given."
    if scenes < LEAST:
        return f"{counted}: too few to say how much others would differ, and no interval is given."
    text = (
        f"Brackets are {LEVEL:.0%} bootstrap intervals over scenes: where the figure may lie for other "
        f"scenes of the same kind. {counted}"
    )
    if scenes >= FEW:
        return text + "."
    return f"{text}, and so few make the intervals wide: of five they go nearly from worst to best."


_LISTED = re.compile(
    r"(demo|surfels|guidance|irradiance|fox|step|reconstruction(\.(depth_init|photos|light))?|splats(\.raw|\.thick)?"
    r"|judge(\.win_rate)?|video\.(warping|flicker|far)(_excess)?|vbench\.\w+)\.[a-z_]\w*"
)
"""Rows without a target that are listed all the same; rows of one scene end in another segment."""


def print_results(results: Results, report: Path) -> None:
    """Print tables of the results and the absolute path of the report, to stdout.

    Metrics with a ``_full`` twin share a line; rows of one light family stay in results.json and the report.
    Brackets are intervals over scenes.
    """
    console = Console(width=None if Console().is_terminal else 120, highlight=False)
    name = Column("figure", overflow="fold")
    pairs = Table(name, "foreground", "full frame", box=None, pad_edge=False)
    others = Table(name.copy(), "measured", "target", "", box=None, pad_edge=False)
    by_metric = {target.metric: target for target in results.targets}
    for row in results.rows:
        full = results.find(f"{row.metric}_full")
        if full is not None:
            values = [with_interval(each) for each in (row, full)]
            pairs.add_row(row.metric, *values)
        target = by_metric.get(row.metric)
        if target is not None:
            words, tone = verdict(target, row.value, row.unit)
            style = "green" if tone == "good" else "red"
            value = with_interval(row)
            others.add_row(row.metric, value, bound(target, row.unit), f"[{style}]{words}[/]")
        elif full is None and _LISTED.fullmatch(row.metric):
            others.add_row(row.metric, with_interval(row), "", "")
    for target in results.targets:
        if results.find(target.metric) is None:
            others.add_row(target.metric, "—", bound(target, ""), "[red]not measured[/]")
    for table in (pairs, others):
        if table.row_count:
            console.print(table)
            console.print()
    # print, not the console: a path must come out whole, on one line
    print(f"report: {report.absolute()}", flush=True)
