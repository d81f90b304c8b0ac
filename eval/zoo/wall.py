"""The wall: every cell, small, on the colour of its mean, and the worst of them beside the truth."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from PIL import Image

from eval.zoo.cells import QUALITIES, Cell
from tron.color import to_display
from tron.io.images import decode_png

THUMB, EDGE, BAR, GAP = 40, 4, 7, 2
"""Pixels: a cell's picture, the border around it, the bar of its errors below, and what parts cells."""
WIDE, HIGH = THUMB + 2 * EDGE + GAP, THUMB + 2 * EDGE + BAR + GAP
ACROSS = 30
"""Cells in a row of blocks."""
BLOCK_GAP, TITLE, HEAD, FOOT = 14, 44, 26, 60
"""Pixels between blocks, and of the title, a block's head and the legend."""
LEFT, NARROWEST = 92, 1420
"""Pixels of the lights' names, and of a wall of few cells."""
MEANS, ERRORS = 0.25, 0.4
"""Distance from 1, and error, at which colours are full."""
WORST, CLOSE_UP = 8, 128
"""Of the worst, a row by mean and a row by error; pixels of each of their pictures."""
NEUTRAL, BRIGHT, DIM, WRONG = (
    np.array([int(h[k : k + 2], 16) / 255 for k in (0, 2, 4)])
    for h in ("e9eaec", "d1352b", "2467b3", "5b1a7a")
)
"""Right; too bright; too dark; the colour of errors."""
INK = "#22252a"


def mean_color(mean: float) -> np.ndarray:
    """(3,) display: neutral at 1, red above, blue below, full at a quarter."""
    share = np.clip(abs(np.log(max(mean, 1e-3))) / np.log(1 + MEANS), 0, 1)
    return NEUTRAL + share * ((BRIGHT if mean > 1 else DIM) - NEUTRAL)


def error_color(error: float) -> np.ndarray:
    """(3,) display: neutral at 0."""
    return NEUTRAL + np.clip(error / ERRORS, 0, 1) * (WRONG - NEUTRAL)


def tile(cell: Cell) -> np.ndarray:
    """(HIGH, WIDE, 3): its final frame before the colours of its means, preview left, final right.

    The bar below has the colours of its errors likewise.
    """
    found = np.ones((HIGH, WIDE, 3))
    inside = WIDE - GAP
    for k, quality in enumerate(QUALITIES):
        columns = slice(k * inside // len(QUALITIES), (k + 1) * inside // len(QUALITIES))
        found[: HIGH - GAP - BAR, columns] = mean_color(cell.mean(quality))
        found[HIGH - GAP - BAR : HIGH - GAP, columns] = error_color(cell.error(quality))
    shown = _resized(to_display(cell.lit["final"], cell.exposure), THUMB, Image.Resampling.BOX)
    share = _resized(np.repeat(cell.covered[..., None], 3, -1), THUMB, Image.Resampling.BOX)
    place = found[EDGE : EDGE + THUMB, EDGE : EDGE + THUMB]
    place += share * (shown - place)
    return found


def worst(
    cells: Sequence[Cell], badness: Callable[[Cell, str], float], most: int = WORST
) -> list[tuple[Cell, str]]:
    """Cells with their worse quality, by descending badness; of a material on a shape the worst alone."""
    pairs = [(cell, max(QUALITIES, key=lambda quality: badness(cell, quality))) for cell in cells]
    found: dict[Any, tuple[Cell, str]] = {}
    for cell, quality in sorted(pairs, key=lambda pair: -badness(*pair)):
        found.setdefault((cell.shape, cell.material), (cell, quality))
    return list(found.values())[:most]


def off(cell: Cell, quality: str) -> float:
    """How far a mean is from 1, as far below as above."""
    return float(abs(np.log(max(cell.mean(quality), 1e-3))))


def draw_wall(cells: Sequence[Cell]) -> np.ndarray:
    """(H, W, 3) display: blocks of shapes, a column a material, a row a light; below them the worst."""
    kinds = list(dict.fromkeys(cell.shape for cell in cells))
    lights = list(dict.fromkeys(cell.light for cell in cells))
    columns = {
        kind: list(dict.fromkeys((c.number, c.material) for c in cells if c.shape == kind)) for kind in kinds
    }
    rows: list[list[str]] = [[]]
    for kind in kinds:
        if rows[-1] and sum(len(columns[each]) for each in [*rows[-1], kind]) > ACROSS:
            rows.append([])
        rows[-1].append(kind)
    width = LEFT + max(sum(len(columns[kind]) * WIDE + BLOCK_GAP for kind in row) for row in rows)
    width = max(width, NARROWEST)
    per_row = max(1, (width - BLOCK_GAP) // (2 * CLOSE_UP + BLOCK_GAP))
    lists = {
        "Farthest means": worst(cells, off, min(WORST, per_row)),
        "Largest errors": worst(cells, lambda cell, quality: cell.error(quality), min(WORST, per_row)),
    }
    block = HEAD + len(lights) * HIGH + BLOCK_GAP
    close = 58 + CLOSE_UP + BLOCK_GAP
    height = TITLE + len(rows) * block + FOOT + len(lists) * close
    canvas, texts = np.ones((height, width, 3)), []
    texts.append((LEFT, 8, "The zoo: lit over path tracing, every material, shape and light", 15, "bold"))
    top = TITLE
    for row in rows:
        left = LEFT
        for n, light in enumerate(lights):
            texts.append((6, top + HEAD + n * HIGH + 18, light, 10, "normal"))
        for kind in row:
            texts.append((left, top + 4, kind, 12, "bold"))
            for cell in (each for each in cells if each.shape == kind):
                x = left + columns[kind].index((cell.number, cell.material)) * WIDE
                y = top + HEAD + lights.index(cell.light) * HIGH
                canvas[y : y + HIGH, x : x + WIDE] = tile(cell)
            left += len(columns[kind]) * WIDE + BLOCK_GAP
        top += block
    _legend(canvas, texts, top)
    top += FOOT
    for title, pairs in lists.items():
        texts.append((6, top, title, 12, "bold"))
        for n, (cell, quality) in enumerate(pairs):
            x, y = 6 + n * (2 * CLOSE_UP + BLOCK_GAP), top + 20
            for k, image in enumerate((cell.truth, cell.lit[quality])):
                shown = _resized(to_display(image, cell.exposure), CLOSE_UP, Image.Resampling.NEAREST)
                share = _resized(np.repeat(cell.counts[..., None], 3, -1), CLOSE_UP, Image.Resampling.NEAREST)
                at = canvas[y : y + CLOSE_UP, x + k * CLOSE_UP : x + (k + 1) * CLOSE_UP]
                at[:] = 0.35 + share * (shown - 0.35)
            words = f"{cell.shape} · {cell.material.words}"
            figures = (
                f"{cell.light}, {quality}: mean {cell.mean(quality):.2f}, error {cell.error(quality):.2f}"
            )
            texts += [
                (x, y + CLOSE_UP + 3, words, 10, "normal"),
                (x, y + CLOSE_UP + 18, figures, 10, "normal"),
            ]
        top += close
    return _lettered(canvas, texts)


def _legend(canvas: np.ndarray, texts: list[Any], top: int) -> None:
    """What colours mean."""
    scales = (
        (
            "mean over truth",
            lambda s: mean_color((1 + MEANS) ** (2 * s - 1)),
            (1 / (1 + MEANS), 1, 1 + MEANS),
        ),
        ("bar: error", lambda s: error_color(s * ERRORS), (0, ERRORS / 2, ERRORS)),
    )
    x = LEFT
    for title, color, marks in scales:
        texts.append((x, top + 4, title, 10, "normal"))
        for k in range(200):
            canvas[top + 6 : top + 18, x + 110 + k] = color(k / 199)
        for k, mark in enumerate(marks):
            texts.append((x + 104 + k * 94, top + 20, f"{mark:.3g}", 9, "normal"))
        x += 350
    said = (
        "Columns are materials (metals first), rows lights. A cell shows its final frame; its left half has",
        "the colours of the preview, its right half those of the final frame. Below: path tracing, then lit.",
    )
    for k, line in enumerate(said):
        texts.append((x, top + 3 + 15 * k, line, 10, "normal"))


def _lettered(canvas: np.ndarray, texts: Sequence[tuple[int, int, str, int, str]]) -> np.ndarray:
    """The picture with words, (x, y, text, pixels of the font, weight) each, y of their top."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height, width = canvas.shape[:2]
    with rc_context({"font.family": "DejaVu Sans"}):
        figure = Figure(figsize=(width / 100, height / 100), dpi=100)
        FigureCanvasAgg(figure)
        figure.figimage(np.clip(canvas, 0, 1), origin="upper")
        for x, y, text, size, weight in texts:
            place = (x / width, 1 - y / height)
            figure.text(*place, text, size=size * 0.72, weight=weight, color=INK, va="top", ha="left")
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", metadata={"Software": None})
    return decode_png(buffer.getvalue())[..., :3]


def _resized(image: np.ndarray, side: int, way: Image.Resampling) -> np.ndarray:
    levels = Image.fromarray((np.clip(image, 0, 1) * 255).round().astype(np.uint8))
    return np.asarray(levels.resize((side, side), way)) / 255.0
