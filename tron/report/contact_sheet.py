"""Contact sheets: pictures in rows and columns on one sheet, with labels or without."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

LABEL_WIDTH, HEADING_HEIGHT = 110, 18
INK = 30


def contact_sheet(
    rows: Sequence[Sequence[np.ndarray]],
    *,
    cell: tuple[int, int] | None = None,
    gap: int = 2,
    border: int = 0,
    paper: int = 255,
    centred: bool = False,
    labels: Sequence[str] = (),
    headings: Sequence[str] = (),
) -> np.ndarray:
    """Lay pictures out as they are, in cells as large as the largest of them.

    Args:
        rows: pictures of each row, :func:`levels` of display values.
        cell: (height, width) of all cells instead.
        gap: pixels of paper right of and below each cell.
        border: above and left of all.
        paper: grey of the sheet, 0 to 255.
        centred: whether a picture stands in the middle of its cell, not in its upper left corner.
        labels: of the rows, on their left; none leaves no room for them.
        headings: of the columns; of one too long for its column the end is shown.

    Returns:
        (H, W, 3) uint8.
    """
    sizes = [image.shape[:2] for row in rows for image in row]
    height, width = cell or (max(size[0] for size in sizes), max(size[1] for size in sizes))
    left, top = border + LABEL_WIDTH * bool(labels), border + HEADING_HEIGHT * bool(headings)
    columns = max(len(headings), *map(len, rows))
    shape = top + len(rows) * (height + gap), left + columns * (width + gap), 3
    sheet = Image.fromarray(np.full(shape, paper, np.uint8))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for number, heading in enumerate(headings):
        place = (left + number * (width + gap), border + 2)
        draw.text(place, heading[-width // 7 :], fill=(INK,) * 3, font=font)
    for number, label in enumerate(labels):
        place = (border + 4, top + number * (height + gap) + 4)
        draw.text(place, label, fill=(INK,) * 3, font=font)
    for down, row in enumerate(rows):
        for across, image in enumerate(row):
            y, x = top + down * (height + gap), left + across * (width + gap)
            if centred:
                y, x = y + (height - image.shape[0]) // 2, x + (width - image.shape[1]) // 2
            sheet.paste(Image.fromarray(image), (x, y))
    return np.asarray(sheet)


def labelled_sheet(
    rows: Mapping[str, Sequence[np.ndarray]], columns: Sequence[str], width: int = 180
) -> np.ndarray:
    """A labelled row of pictures for each channel, a column for each view: (H, W, 3) uint8.

    Args:
        rows: label -> one display image (h, w, 3) or (h, w) in [0, 1] a column.
        columns: heading of each column.
        width: of a picture on the sheet, pixels; small ones are enlarged without smoothing.
    """
    shown = [[levels(image, width) for image in images] for images in rows.values()]
    return contact_sheet(shown, labels=list(rows), headings=columns)


def levels(image: np.ndarray, width: int | None = None) -> np.ndarray:
    """A display image (h, w, 3) or (h, w) in [0, 1] as (h, w, 3) uint8, made ``width`` pixels wide."""
    color = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    found = np.round(255 * np.clip(color, 0, 1)).astype(np.uint8)
    if width is None:
        return found
    size = (width, max(1, round(width * found.shape[0] / found.shape[1])))
    enlarged = found.shape[1] < width
    how = Image.Resampling.NEAREST if enlarged else Image.Resampling.LANCZOS
    return np.asarray(Image.fromarray(found).resize(size, how))
