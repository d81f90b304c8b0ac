"""A sheet of pictures: a labelled row for each channel, a column for each view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

_LABEL_WIDTH = 110
_GAP = 2
_PAPER, _INK = 255, 30


def labelled_sheet(
    rows: Mapping[str, Sequence[np.ndarray]], columns: Sequence[str], width: int = 180
) -> np.ndarray:
    """(H, W, 3) uint8 picture.

    Args:
        rows: label -> one display image (h, w, 3) or (h, w) in [0, 1] a column, all of one size within a
            column.
        columns: heading of each column.
        width: of a picture on the sheet, pixels; small ones are enlarged without smoothing.
    """
    first = next(iter(rows.values()))
    height = max(round(width * image.shape[0] / image.shape[1]) for image in first)
    font = ImageFont.load_default(12)
    size = (
        _LABEL_WIDTH + len(columns) * (width + _GAP),
        18 + len(rows) * (height + _GAP),
    )
    sheet = Image.new("RGB", size, (_PAPER,) * 3)
    draw = ImageDraw.Draw(sheet)
    for column, heading in enumerate(columns):
        place = (_LABEL_WIDTH + column * (width + _GAP), 2)
        draw.text(place, heading[-width // 7 :], fill=(_INK,) * 3, font=font)
    for row, (label, images) in enumerate(rows.items()):
        top = 18 + row * (height + _GAP)
        draw.text((4, top + 4), label, fill=(_INK,) * 3, font=font)
        for column, image in enumerate(images):
            sheet.paste(thumbnail(image, width), (_LABEL_WIDTH + column * (width + _GAP), top))
    return np.asarray(sheet)


def thumbnail(image: np.ndarray, width: int) -> Image.Image:
    """A display image (h, w, 3) or (h, w) in [0, 1] made `width` pixels wide, as 8-bit RGB."""
    color = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    picture = Image.fromarray(np.round(255 * np.clip(color, 0, 1)).astype(np.uint8))
    size = (width, max(1, round(width * picture.height / picture.width)))
    enlarged = picture.width < width
    return picture.resize(size, Image.Resampling.NEAREST if enlarged else Image.Resampling.LANCZOS)
