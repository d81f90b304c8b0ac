"""sheet.png: up to 64 scenes of a dataset at a glance, one thumbnail each."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from datagen.clip_preview import LARGEST_SIDE
from datagen.clip_rows import ClipRow
from tron.errors import TronError
from tron.images import encode_png

SHEET_NAME = "sheet.png"
SIDE = 8
"""Scenes in a row, and rows."""
GUTTER = 4
PAPER = 128


def sheet_clips(rows: Sequence[ClipRow], most: int = SIDE * SIDE) -> list[ClipRow]:
    """One clip each of at most ``most`` scenes, evenly over splits and styles, and over lights.

    Each pair of split and style gets the same number of places, or as many as it has scenes; its scenes are
    taken at even distances. The k-th scene shows its k-th light, in turns.
    """
    scenes: dict[tuple[str, str], dict[str, list[ClipRow]]] = {}
    for row in rows:
        if row.thumbnail is not None:
            scenes.setdefault((row.split, row.style), {}).setdefault(row.scene, []).append(row)
    places = dict.fromkeys(scenes, 0)
    left = min(most, sum(map(len, scenes.values())))
    while left:
        for kind in scenes:
            if left and places[kind] < len(scenes[kind]):
                places[kind] += 1
                left -= 1
    found = []
    for kind, count in places.items():
        clips = list(scenes[kind].values())
        found += [clips[int((k + 0.5) * len(clips) / count)] for k in range(count)]
    return [lights[number % len(lights)] for number, lights in enumerate(found)]


def contact_sheet(folder: Path, rows: Sequence[ClipRow]) -> bytes | None:
    """PNG of the scenes, at most eight by eight; None where no clip has a thumbnail.

    Thumbnails are fitted into squares as large as the largest of them, and stay as small as LARGEST_SIDE.

    Raises:
        TronError: a thumbnail is missing or damaged.
    """
    chosen = sheet_clips(rows)
    if not chosen:
        return None
    pictures = [_thumbnail(folder, row) for row in chosen]
    tile = min(max(max(picture.size) for picture in pictures), LARGEST_SIDE)
    columns = min(SIDE, math.ceil(math.sqrt(len(pictures))))
    step, sheet_rows = tile + GUTTER, math.ceil(len(pictures) / columns)
    sheet = Image.new("RGB", (columns * step + GUTTER, sheet_rows * step + GUTTER), (PAPER,) * 3)
    for number, picture in enumerate(pictures):
        scale = tile / max(picture.size)
        width, height = (max(round(scale * side), 1) for side in picture.size)
        size = (width, height)
        fitted = picture if size == picture.size else picture.resize(size, Image.Resampling.BICUBIC)
        x, y = number % columns * step + GUTTER, number // columns * step + GUTTER
        sheet.paste(fitted, (x + (tile - width) // 2, y + (tile - height) // 2))
    return encode_png(np.asarray(sheet))


def _thumbnail(folder: Path, row: ClipRow) -> Image.Image:
    path = folder / str(row.thumbnail)
    try:
        return Image.open(io.BytesIO(path.read_bytes()), formats=("JPEG",)).convert("RGB")
    except OSError as error:
        mend = f"delete scenes/{row.scene}/record.json, and start the run again: it makes the scene anew"
        raise TronError(f"thumbnail cannot be read: {error.strerror or error}", path, mend) from error
