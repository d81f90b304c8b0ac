"""Pages: a jinja2 template -> one HTML file that fetches nothing.

Pictures are data URIs, the style is inline, there is no script but what a template has. To write a page of
your own, put the sentences into a template beside your code and the figures into blocks, and call
``render_template("mypackage", "mine.html.j2", ...)``::

    {% extends "page.html.j2" %}
    {% set title = "What was reconstructed" %}
    {% block verdict %}Held-out views reach {{ psnr }} dB.{% endblock %}
    {% block lead %}<p class="lead">A paragraph for who has never seen this.</p>{% endblock %}
    {% block body %}
    {% call section("views", "Held-out views") %}
    <p>The middle view of each scene.</p>
    {{ show(table) }}      {# a block of tron.report.page, or several: Table, Pictures, Films, Chart, Code #}
    {{ show(pictures) }}
    {% endcall %}
    {% endblock %}
    {% block footer %}Made by tron-reconstruct.{% endblock %}

``show(None)`` shows nothing, and a section of which nothing was shown is left out, so that a template names
all that may be there. Every value is escaped; the template's own words are HTML.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import resources
from itertools import groupby
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup, escape
from PIL import Image

from tron.io.images import encode_png
from tron.report.page import Block, Table

HOME = "tron.report"
LOSSLESS_PIXELS = 256 * 256
"""Up to this size a picture is stored as PNG; a larger one as JPEG, which keeps the page light."""
PAGE = 78.0
"""Width of a page in a window of 1,280 pixels, em of the table's type."""
LETTER, NARROW = 0.6, 0.32
"""Widths of letters and of " .,[]": digits of common sans-serif types have 0.56, points 0.28."""
PADDING = 1.75
NAME, WORDS = 20.0, 12.0
"""Most that the first column asks for, whose words break; and least that columns of words do."""
BRACKET = re.compile(r"^(.*\S) (\[[^\]]*\])$")
"""A figure and its interval, which stands below it."""


def data_uri(image: np.ndarray) -> str:
    """An image (H, W, 3) in [0, 1] as a ``data:`` URI: PNG or, when large, JPEG of quality 92."""
    clipped = np.clip(image, 0, 1)
    if image.shape[0] * image.shape[1] <= LOSSLESS_PIXELS:
        return "data:image/png;base64," + base64.b64encode(encode_png(clipped)).decode()
    buffer = io.BytesIO()
    Image.fromarray(np.round(clipped * 255).astype(np.uint8)).save(buffer, "JPEG", quality=92, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()


def film_uri(video: bytes) -> str:
    """An MP4 as a ``data:`` URI."""
    return "data:video/mp4;base64," + base64.b64encode(video).decode()


def broken(text: str) -> Markup:
    """A figure with its interval on a line of its own; any other text as it is."""
    found = pieces(text)
    if len(found) == 1:
        return escape(text)
    return Markup(" ").join(Markup("<span>{}</span>").format(piece) for piece in found)


def render_template(package: str, name: str, brand: str = "report", **values: Any) -> str:
    """A template as HTML.

    Args:
        package: that has the template; those of this package may be extended.
        name: of the template's file.
        brand: says behind the project's name what kind of page it is.
        values: by their names in the template; ``tiles`` are :class:`tron.report.page.Tile`s.
    """

    def load(name: str) -> str | None:
        places = (resources.files(each).joinpath(name) for each in (package, HOME))
        return next((place.read_text("utf-8") for place in places if place.is_file()), None)

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(load),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"data_uri": data_uri, "film_uri": film_uri, "fitting": fitting, "broken": broken}
    macro = getattr(environment.get_template("blocks.html.j2").module, "show")  # noqa: B009
    contents: list[tuple[str, str]] = []
    shown = 0

    def show(block: Block | Sequence[Block] | None) -> Markup:
        nonlocal shown
        blocks = [] if block is None else block if isinstance(block, Sequence) else [block]
        shown += len(blocks)
        return Markup("").join(map(macro, blocks))

    def section(name: str, title: str, caller: Callable[[], str]) -> Markup:
        before, text = shown, caller()
        if shown == before:
            return Markup("")
        contents.append((name, title))
        return Markup('<section id="{}">\n<h2>{}</h2>\n{}</section>\n').format(name, title, text)

    style = Markup(resources.files(HOME).joinpath("style.css").read_text("utf-8"))
    environment.globals |= {"show": show, "section": section, "contents": contents, "style": style}
    return environment.get_template(name).render(brand=brand, **values).lstrip()


def fitting(table: Table) -> list[Table]:
    """The table itself, or tables of as even a number of its columns as fit, each with the first column.

    A browser that has too little room for a table hides its right end behind a scroll bar, where the last
    figures are overlooked. Widths are estimated, in em of the table's type; the page's style breaks lines
    likewise. Rows that have nothing in a part's columns are left out of it.
    """
    first, *widths = _widths(table)
    parts = _packed(widths, PAGE - first)
    if len(parts) == 1:
        return [table]
    return [_part(table, columns, number, len(parts)) for number, columns in enumerate(parts, 1)]


def _widths(table: Table) -> list[float]:
    found = []
    for column, heading in enumerate(table.headings):
        cells = [row[column].text for row in table.cells if column < len(row)]
        if column == 0:
            asked = min(max(map(_length, (*cells, heading))), NAME)
        elif column in table.words:
            asked = WORDS
        else:
            asked = max(
                map(_length, (*heading.split(), *(part for cell in cells for part in pieces(cell)), ""))
            )
        found.append(asked + PADDING)
    return found


def _length(piece: str) -> float:
    narrow = sum(piece.count(letter) for letter in " .,[]")
    return NARROW * narrow + LETTER * (len(piece) - narrow)


def pieces(text: str) -> tuple[str, ...]:
    """Parts of a cell that stay on one line each: a figure and its interval, or all of it."""
    found = BRACKET.match(text)
    return found.groups() if found else (text,)


def _packed(widths: list[float], room: float) -> list[list[int]]:
    """Columns (from 1) in as few runs as have the room, the widest run as narrow as that allows."""

    def runs(most: float) -> list[list[int]]:
        found: list[list[int]] = [[]]
        used = 0.0
        for column, width in enumerate(widths, 1):
            if found[-1] and used + width > most:
                found.append([])
                used = 0.0
            found[-1].append(column)
            used += width
        return found

    fewest = len(runs(room))
    steps = (room * k / 40 for k in range(1, 41))
    return next(found for step in steps if len(found := runs(step)) == fewest)


def _part(table: Table, columns: list[int], number: int, count: int) -> Table:
    kept = [0, *columns]
    labels = [text for text, span in table.groups for _ in range(span)]
    runs = groupby(labels[column] for column in kept) if labels else ()
    cells = [[row[column] for column in kept if column < len(row)] for row in table.cells]
    return replace(
        table,
        caption=table.caption if number == 1 else f"The same, part {number} of {count}.",
        headings=[table.headings[column] for column in kept],
        rows=[row for row in cells if any(cell.text for cell in row[1:])],
        groups=[(text, len(list(run))) for text, run in runs],
        words=[place for place, column in enumerate(kept) if column in table.words],
    )
