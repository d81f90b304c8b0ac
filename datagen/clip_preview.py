"""Preview of a clip in index.html: a thumbnail, and a script with the linear values of its frames.

No browser reads EXR, and a page opened from a folder may neither fetch files beside it nor read the pixels of
pictures beside it. It may run scripts beside it, so a clip's frames lie in one: PNGs whose pixels hold the
logarithm of the light in 12 bits a channel, from which the page computes radiance again.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from datagen.preview import DEPTHS, displayable, is_light, shown_as_is
from tron.color import to_display
from tron.images import encode_jpeg, encode_png
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
    """A call of the page's ``showClip`` with every tile: member, frame, whether it is light, PNG."""
    tiles = [_tile(meta, TARGET, number, frames[number]) for number in shown_frames(len(frames))]
    members = [name for name in MEMBERS if name in frames[0] and name not in (TARGET, *DEPTHS)]
    tiles += [_tile(meta, name, 0, frames[0]) for name in members]
    return f"showClip({json.dumps({'key': meta.key, 'tiles': tiles}, separators=(',', ':'))});\n"


def preview_bytes(width: int, height: int, frames: int, members: int) -> int:
    """Bytes that a clip's previews may take: its size in pixels, its frames, the members of a frame."""
    step = -(-max(width, height) // LARGEST_SIDE)
    pixels = (width // step) * (height // step)
    return (len(shown_frames(frames)) + members) * pixels * TILE_BYTES + pixels


def shown_frames(count: int) -> list[int]:
    """Numbers of the frames that a preview holds, of ``count``."""
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
    """(H', W', 3) float32 of (H, W), (H, W, 1) or (H, W, 3): means over squares if it is too large."""
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
