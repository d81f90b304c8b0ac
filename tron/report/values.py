"""Numbers with their units as text."""

from __future__ import annotations

MINUS = "\N{MINUS SIGN}"
_STYLES = {
    "fraction": (100, 2, "%"),
    "s": (1, 0, " s"),
    "deg": (1, 2, "°"),
    "1": (1, 3, ""),
    "x": (1, 2, "×"),
    "surfels": (1, 0, " surfels"),
    "views": (1, 0, " views"),
    "kills": (1, 0, " kills"),
    "frames/h": (1, 0, " frames/h"),
}
"""Unit -> factor, decimals, what is written behind the number."""


def format_value(value: float, unit: str, signed: bool = False) -> str:
    """A figure with its unit: fractions as percent, seconds as minutes too or with decimals.

    >>> format_value(0.0123, "fraction"), format_value(31.456, "dB"), format_value(754, "s")
    ('1.23%', '31.46 dB', '12 min 34 s')
    """
    if unit == "s" and not signed and abs(value) >= 60:
        minutes, seconds = divmod(round(value), 60)
        return f"{minutes} min {seconds} s"
    if unit == "abs":  # errors of computation, many orders below one
        return f"{value:.1e}".replace("-", MINUS)
    scale, digits, suffix = _STYLES.get(unit, (1, 2, f" {unit}"))
    if unit == "s" and abs(value) < 10:
        digits = 2
    value = round(scale * value, digits) + 0.0  # adding zero turns a negative zero into zero
    return f"{value:{'+' if signed and value else ''}.{digits}f}{suffix}".replace("-", MINUS)


def suffix(unit: str) -> str:
    """Sign or words that :func:`format_value` writes behind the number: ``%``, ``°``, `` dB``."""
    return _STYLES.get(unit, (1, 2, f" {unit}"))[2]
