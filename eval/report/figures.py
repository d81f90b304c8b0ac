"""Figures and verdicts as text: in tables, in tiles and on the terminal."""

from __future__ import annotations

from eval.results import Row, Target
from tron.report.page import Cell, Tone
from tron.report.values import format_value, suffix


def with_interval(row: Row, signed: bool = False) -> str:
    """A row's figure with its unit, and its interval over scenes behind it: ``34.10 dB [32.85, 35.20]``."""
    figure = format_value(row.value, row.unit, signed)
    if row.low is None or row.high is None:
        return figure
    unit = suffix(row.unit)
    low, high = (format_value(end, row.unit, signed).removesuffix(unit) for end in (row.low, row.high))
    return f"{figure} [{low}, {high}]"


def row_cell(row: Row | None, tone: Tone = "plain", unit: bool = True) -> Cell:
    """A row's figure and interval as a cell, a dash if it was not measured; ``unit`` False leaves dB out."""
    text = "—" if row is None else with_interval(row)
    return Cell(text if unit else text.replace(" dB", ""), tone)


def verdict(target: Target, measured: float | None, unit: str) -> tuple[str, Tone]:
    """The finding on one target in words, with its tone: reached or missed, and by how much."""
    if measured is None:
        return "not measured", "plain"
    margin = target.margin(measured)
    amount = format_value(abs(margin), unit) if unit != "s" else f"{abs(margin):.0f} s"
    if target.reached(measured):
        return f"reached, {amount} to spare", "good"
    return f"missed by {amount}", "bad"


def bound(target: Target, unit: str) -> str:
    """The bound itself: ``at least 3.00 dB``; without a unit, of what was not measured, ``at least 3``."""
    return f"{target.bound} {format_value(target.value, unit) if unit else f'{target.value:g}'}"
