"""What a report is made of: plain blocks that a benchmark fills in, without a word of HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np

Tone = Literal["plain", "good", "bad", "strong", "faint"]


@dataclass(frozen=True)
class Text:
    """A paragraph of plain text."""

    kind: ClassVar[str] = "text"
    text: str


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

    ``groups`` are headings over several columns: (text, number of columns), from the left. Columns in
    ``words`` hold text instead of figures, and may break into lines.
    """

    kind: ClassVar[str] = "table"
    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    groups: Sequence[tuple[str, int]] = ()
    words: Sequence[int] = ()


@dataclass(frozen=True)
class Picture:
    """image (H, W, 3) display values in [0, 1]; ``figure`` is a short number under the title, such as "24.1
    dB".
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
class Chart:
    """Inline SVG (made by :mod:`eval.report.charts`) with a caption and a text in its place."""

    kind: ClassVar[str] = "chart"
    svg: str
    caption: str
    alt: str


Block = Text | Code | Table | Pictures | Chart


@dataclass(frozen=True)
class Section:
    """A part of the page with an entry in its table of contents; ``name`` is its anchor."""

    name: str
    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Tile:
    """One headline figure: what, how much, and the verdict on it in words."""

    label: str
    value: str
    verdict: str = ""
    tone: Tone = "plain"


@dataclass(frozen=True)
class Page:
    """A whole report."""

    title: str
    verdict: str
    lead: Sequence[str]
    tiles: Sequence[Tile]
    sections: Sequence[Section] = field(default_factory=list)
    footer: str = ""
