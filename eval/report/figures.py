"""How figures and verdicts are written, in tables, tiles and on the terminal."""

from __future__ import annotations

from eval.report.page import Tone
from eval.results import Target


def written(value: float, unit: str, signed: bool = False) -> str:
    """A figure with its unit: fractions as percent, seconds beyond a minute as minutes too.

    >>> written(0.0123, "fraction"), written(31.456, "dB"), written(754, "s")
    ('1.23%', '31.46 dB', '12 min 34 s')
    """
    sign = "+" if signed else ""
    if unit == "fraction":
        return f"{100 * value:{sign}.2f}%"
    if unit == "s":
        if signed or abs(value) < 60:
            return f"{value:{sign}.0f} s"
        minutes, seconds = divmod(round(value), 60)
        return f"{minutes} min {seconds} s"
    if unit == "deg":
        return f"{value:{sign}.2f}°"
    if unit == "1":
        return f"{value:{sign}.3f}"
    return f"{value:{sign}.2f} {unit}"


def verdict(target: Target, measured: float | None, unit: str) -> tuple[str, Tone]:
    """The finding on one target in words, with its tone: reached or missed, and by how much."""
    if measured is None:
        return "not measured", "bad"
    margin = target.margin(measured)
    amount = written(abs(margin), unit) if unit != "s" else f"{abs(margin):.0f} s"
    if target.reached(measured):
        return f"reached, {amount} to spare", "good"
    return f"missed by {amount}", "bad"


def bound(target: Target, unit: str) -> str:
    """The bound itself: ``at least 3.00 dB``."""
    return f"{target.bound} {written(target.value, unit)}"
