"""Blocks that a report is made of, filled in without a word of HTML, and numbers with their units as text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

Tone = Literal["plain", "good", "bad", "strong", "faint"]
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
    "faults": (1, 0, " faults"),
    "frames/h": (1, 0, " frames/h"),
    "bytes": (1e-3, 0, " kB"),
}
"""Unit -> factor, decimals, what is written behind the number."""


@dataclass(frozen=True)
class Code:
    """Lines to be typed, shown as they are."""

    kind: ClassVar[str] = "code"
    text: str


@dataclass(frozen=True)
class Cell:
    """One cell of a table; ``tone`` colours it, and its text never depends on the colour to be understood."""

    text: str
    tone: Tone = "plain"


@dataclass(frozen=True)
class Table:
    """Rows of cells under headings; the first column names the row, the others hold figures.

    Attributes:
        caption: what the table shows.
        headings: of the columns.
        rows: cells from the left; a string is a plain one.
        groups: headings over several columns: (text, number of columns), from the left.
        words: columns that hold text instead of figures, and may break into lines.
    """

    kind: ClassVar[str] = "table"
    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[Cell | str]]
    groups: Sequence[tuple[str, int]] = ()
    words: Sequence[int] = ()

    @property
    def cells(self) -> list[list[Cell]]:
        """The rows with every string as a cell."""
        return [[Cell(cell) if isinstance(cell, str) else cell for cell in row] for row in self.rows]


@dataclass(frozen=True)
class Picture:
    """A picture with its title.

    Attributes:
        image: (H, W, 3) display values in [0, 1].
        title: words under it.
        alt: words in its place.
        figure: a short number behind the title, such as "24.1 dB".
        strong: drawn with a frame, as the one that the others are held against.
    """

    image: np.ndarray
    title: str
    alt: str
    figure: str = ""
    strong: bool = False


@dataclass(frozen=True)
class Pictures:
    """Pictures that belong together, side by side, under a title of their own."""

    kind: ClassVar[str] = "pictures"
    title: str
    pictures: Sequence[Picture]
    note: str = ""
    columns: int = 4


@dataclass(frozen=True)
class Film:
    """A short silent film that plays on and on.

    Attributes:
        video: bytes of an MP4 (:mod:`tron.io.video`).
        size: width and height, pixels.
        title: words under it.
        alt: words in its place.
    """

    video: bytes
    size: tuple[int, int]
    title: str
    alt: str


@dataclass(frozen=True)
class Films:
    """Films that belong together, side by side, under a title of their own."""

    kind: ClassVar[str] = "films"
    title: str
    films: Sequence[Film]
    note: str = ""
    columns: int = 3


@dataclass(frozen=True)
class Chart:
    """Inline SVG (such as :mod:`tron.report.charts` makes) with a caption and a text in its place."""

    kind: ClassVar[str] = "chart"
    svg: str
    caption: str
    alt: str


Block = Code | Table | Pictures | Films | Chart


@dataclass(frozen=True)
class Tile:
    """One headline figure: its name, value and interval, and the verdict on it in words."""

    label: str
    value: str
    interval: str = ""
    verdict: str = ""
    tone: Tone = "plain"


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
