"""Pictures of a dataset: a preview of each clip, a contact sheet of each shard, one of the scenes.

A clip's preview in index.html is a thumbnail, and a script with the linear values of its frames. No browser
reads EXR, and a page opened from a folder may neither fetch files beside it nor read the pixels of pictures
beside it. It may run scripts beside it, so a clip's frames lie in one: PNGs whose pixels hold the logarithm
of the light in 12 bits a channel, from which the page computes radiance again.
"""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from datagen.dataset.records import ClipRow
from tron.color import linear_to_srgb, to_display
from tron.errors import TronError
from tron.io.images import encode_jpeg, encode_png
from tron.report.contact_sheet import contact_sheet, levels
from tron.shards.schema import MEMBERS, TARGET, ClipMeta
from tron.storage import write_atomic

LARGEST_SIDE = 256
"""Pixels of a preview's longer side; larger frames are averaged down over whole squares of pixels."""
MOST_FRAMES = 8
"""Frames of the path-traced picture in a preview, evenly from first to last; of other members the first."""
LOG2_RANGE = (-16.0, 16.0)
"""Base-2 logarithms of radiance that codes 1 to CODES stand for; code 0 is black and whatever lies below."""
CODES = 4095
TILE_BYTES = 6
"""Bytes of a tile a pixel: three channels of 12 bits that hardly compress, and base64 adds a third."""
DEPTHS = ("depth", "depth_ref")  # in world units, which no picture shows
COLUMNS = tuple(name for name in MEMBERS if name not in ("foreground", *DEPTHS))
LARGEST_TILE = 160
SHEET_NAME = "sheet.png"
SIDE = 8
"""Scenes in a row of the dataset's sheet, and rows."""


def write_preview(folder: Path, meta: ClipMeta, frames: Sequence[dict[str, np.ndarray]]) -> None:
    """Write ``previews/KEY.jpg`` and ``previews/KEY.js`` of a clip, the same bytes for the same frames."""
    picture = shrink(frames[0][TARGET])
    if not shown_as_is(meta, TARGET):
        picture = np.asarray(to_display(picture, meta.exposure))
    write_atomic(folder / thumbnail_name(meta.key), encode_jpeg(picture))
    write_atomic(folder / script_name(meta.key), script(meta, frames))


def thumbnail_name(key: str) -> str:
    """Path of a clip's thumbnail in the dataset: first frame, AgX at the clip's exposure."""
    return f"previews/{key}.jpg"


def script_name(key: str) -> str:
    """Path of the script that holds a clip's frames."""
    return f"previews/{key}.js"


def script(meta: ClipMeta, frames: Sequence[dict[str, np.ndarray]]) -> str:
    """Return a call of the page's ``showClip`` with every tile: member, frame, whether it is light, PNG."""
    tiles = [_tile(meta, TARGET, number, frames[number]) for number in shown_frames(len(frames))]
    members = [name for name in MEMBERS if name in frames[0] and name not in (TARGET, *DEPTHS)]
    tiles += [_tile(meta, name, 0, frames[0]) for name in members]
    return f"showClip({json.dumps({'key': meta.key, 'tiles': tiles}, separators=(',', ':'))});\n"


def preview_bytes(width: int, height: int, frames: int, members: int) -> int:
    """Return an upper bound of the bytes of a clip's previews, from its size, frames and members."""
    step = -(-max(width, height) // LARGEST_SIDE)
    pixels = (width // step) * (height // step)
    return (len(shown_frames(frames)) + members) * pixels * TILE_BYTES + pixels


def shown_frames(count: int) -> list[int]:
    """Return the numbers of the frames in a preview, out of ``count``."""
    return sorted({round(k) for k in np.linspace(0, count - 1, min(count, MOST_FRAMES))})


def _tile(meta: ClipMeta, member: str, number: int, frame: dict[str, np.ndarray]) -> dict[str, Any]:
    image = shrink(frame[member])
    light = is_light(member) and not shown_as_is(meta, member)
    png = encode_png(log_pixels(image) if light else displayable(member, image))
    return {
        "member": member,
        "frame": number,
        "light": light,
        "png": "data:image/png;base64," + base64.b64encode(png).decode(),
    }


def shrink(image: np.ndarray) -> np.ndarray:
    """Reduce (H, W), (H, W, 1) or (H, W, 3) to (H', W', 3) float32 by means over squares, if too large."""
    image = np.asarray(image, np.float32)
    image = image if image.ndim == 3 else image[..., None]
    step = -(-max(image.shape[:2]) // LARGEST_SIDE)
    height, width = (max(size // step, 1) for size in image.shape[:2])
    rows, columns = min(step, image.shape[0]), min(step, image.shape[1])
    squares = image[: height * rows, : width * columns].reshape(height, rows, width, columns, -1)
    mean = squares.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
    return np.broadcast_to(mean, (height, width, 3))


def log_pixels(linear: np.ndarray) -> np.ndarray:
    """(2H, W, 3) uint8: the upper 8 bits of each code, and below them the lower 4.

    code = 1 + (CODES - 1) (log2 v - low) / (high - low), rounded: a step is 0.0078 stops, so a value is off
    by at most 0.27 percent, an eighth of a step of an 8-bit AgX picture. Values below 2^low are black.
    """
    low, high = LOG2_RANGE
    value = np.clip(np.asarray(linear, np.float64), 2.0**low, 2.0**high)
    codes = np.rint(1 + (CODES - 1) * (np.log2(value) - low) / (high - low)).astype(np.int64)
    codes[np.asarray(linear) < 2.0**low] = 0
    return np.concatenate([codes >> 4, codes & 15]).astype(np.uint8)


def contact_row(meta: ClipMeta, frame: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Return one frame's members as tiles, (H, W, 3) uint8 each.

    Light is shown by the clip's exposure and AgX, other members by :func:`displayable`.
    """
    tiles = []
    for member in (name for name in COLUMNS if name in frame):
        image = np.asarray(frame[member], np.float32)
        image = image if image.ndim == 3 else image[..., None]
        step = -(-max(image.shape[:2]) // LARGEST_TILE)
        image = np.broadcast_to(image[::step, ::step], (*image[::step, ::step].shape[:2], 3))
        if is_light(member) and not shown_as_is(meta, member):
            image = np.asarray(to_display(image, meta.exposure), np.float32)
        else:
            image = displayable(member, image)
        tiles.append(levels(image))
    return tiles


def is_light(member: str) -> bool:
    """Whether a member is radiance or irradiance, so that exposure applies; base color is neither."""
    return MEMBERS[member].color_space == "linear" and not member.startswith("base_color")


def shown_as_is(meta: ClipMeta, member: str) -> bool:
    """Whether a clip has a member in display values, such as photos."""
    return meta.color_space.get(member) == "display"


def displayable(member: str, image: np.ndarray) -> np.ndarray:
    """Return display values of a member that is not light, (H, W, C) in [0, 1], without exposure.

    Reflectance goes through the sRGB curve, normals through (n + 1) / 2.
    """
    if member.startswith("base_color") or MEMBERS[member].color_space == "reflectance":
        image = np.asarray(linear_to_srgb(np.clip(image, 0.0, 1.0)), np.float32)
    elif member.startswith("normal"):
        image = np.where(np.abs(image).sum(-1, keepdims=True) > 0, 0.5 * image + 0.5, 0.0)
    return np.clip(image, 0.0, 1.0)


def sheet_name(shard: str) -> str:
    """Return previews/NAME.png for a shard's file name."""
    return f"previews/{Path(shard).stem}.png"


def sheet_clips(rows: Sequence[ClipRow]) -> list[ClipRow]:
    """Choose one clip each of at most SIDE x SIDE scenes, evenly over splits, styles and lights.

    Each pair of split and style gets the same number of places, or as many as it has scenes; its scenes are
    taken at even distances. The k-th scene shows its k-th light, in turns.
    """
    scenes: dict[tuple[str, str], dict[str, list[ClipRow]]] = {}
    for row in rows:
        if row.thumbnail is not None:
            scenes.setdefault((row.split, row.style), {}).setdefault(row.scene, []).append(row)
    places = dict.fromkeys(scenes, 0)
    left = min(SIDE * SIDE, sum(map(len, scenes.values())))
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


def scenes_sheet(folder: Path, rows: Sequence[ClipRow]) -> bytes | None:
    """Return a PNG of the scenes, at most eight by eight; None if no clip has a thumbnail.

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
    fitted = []
    for picture in pictures:
        scale = tile / max(picture.size)
        size = max(round(scale * picture.width), 1), max(round(scale * picture.height), 1)
        resized = picture if size == picture.size else picture.resize(size, Image.Resampling.BICUBIC)
        fitted.append(np.asarray(resized))
    rows_of = [fitted[k : k + columns] for k in range(0, len(fitted), columns)]
    return encode_png(contact_sheet(rows_of, cell=(tile, tile), gap=4, border=4, paper=128, centred=True))


def _thumbnail(folder: Path, row: ClipRow) -> Image.Image:
    path = folder / str(row.thumbnail)
    try:
        return Image.open(io.BytesIO(path.read_bytes()), formats=("JPEG",)).convert("RGB")
    except OSError as error:
        mend = f"delete scenes/{row.scene}/record.json, and start the run again: it makes the scene anew"
        raise TronError(f"thumbnail cannot be read: {error.strerror or error}", path, mend) from error
