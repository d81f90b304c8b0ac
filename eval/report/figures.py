"""Figures and verdicts as text: in tables, in tiles and on the terminal."""

from __future__ import annotations

from eval.report.page import Cell, Tone
from eval.results import Row, Target

MINUS = "\N{MINUS SIGN}"
_STYLES = {
    "fraction": (100, 2, "%"),
    "s": (1, 0, " s"),
    "deg": (1, 2, "°"),
    "1": (1, 3, ""),
    "x": (1, 2, "×"),
    "surfels": (1, 0, " surfels"),
    "views": (1, 0, " views"),
}
"""Unit -> factor, decimals, what is written behind the number."""


def format_value(value: float, unit: str, signed: bool = False) -> str:
    """A figure with its unit: fractions as percent, seconds beyond a minute as minutes too, factors with ×.

    >>> format_value(0.0123, "fraction"), format_value(31.456, "dB"), format_value(754, "s")
    ('1.23%', '31.46 dB', '12 min 34 s')
    """
    if unit == "s" and not signed and abs(value) >= 60:
        minutes, seconds = divmod(round(value), 60)
        return f"{minutes} min {seconds} s"
    if unit == "abs":  # errors of computation, many orders below one
        return f"{value:.1e}".replace("-", MINUS)
    scale, digits, suffix = _STYLES.get(unit, (1, 2, f" {unit}"))
    value = round(scale * value, digits) + 0.0  # adding zero turns a negative zero into zero
    return f"{value:{'+' if signed and value else ''}.{digits}f}{suffix}".replace("-", MINUS)


def with_interval(row: Row, signed: bool = False) -> str:
    """A row's figure with its unit, and its interval over scenes behind it: ``34.10 dB [32.85, 35.20]``."""
    figure = format_value(row.value, row.unit, signed)
    if row.low is None or row.high is None:
        return figure
    suffix = _STYLES.get(row.unit, (1, 2, f" {row.unit}"))[2]
    low, high = (format_value(end, row.unit, signed).removesuffix(suffix) for end in (row.low, row.high))
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
