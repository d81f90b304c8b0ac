"""Contact sheets: a look at every shard before anybody trains on it, and an index of them."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from tron.color import to_display
from tron.images import write_image
from tron.shards.manifest import ShardEntry
from tron.shards.schema import MEMBERS, ClipMeta

DEPTHS = ("depth", "depth_ref")  # in world units, which no picture shows
COLUMNS = tuple(name for name in MEMBERS if name not in ("foreground", *DEPTHS))
LARGEST_TILE = 160
GUTTER = 2


def contact_row(meta: ClipMeta, frame: dict[str, np.ndarray]) -> np.ndarray:
    """One frame's members side by side, (H, W', 3) float32 in [0, 1], ready for display.

    Base color goes through the square root (near enough to sRGB to look at), light through the clip's
    exposure and AgX, normals through (n + 1) / 2.
    """
    tiles = []
    for member in (name for name in COLUMNS if name in frame):
        image = np.asarray(frame[member], np.float32)
        image = image if image.ndim == 3 else image[..., None]
        step = -(-max(image.shape[:2]) // LARGEST_TILE)
        image = np.broadcast_to(image[::step, ::step], (*image[::step, ::step].shape[:2], 3))
        if member.startswith("base_color"):
            image = np.sqrt(np.clip(image, 0.0, 1.0))
        elif MEMBERS[member].color_space == "linear":
            image = np.asarray(to_display(image, meta.exposure), np.float32)
        elif member.startswith("normal"):
            image = np.where(np.abs(image).sum(-1, keepdims=True) > 0, 0.5 * image + 0.5, 0.0)
        tiles.append(
            np.pad(np.clip(image, 0.0, 1.0), ((0, GUTTER), (0, GUTTER), (0, 0)), constant_values=1.0)
        )
    return np.concatenate(tiles, axis=1)


def write_sheet(path: Path, rows: Sequence[np.ndarray]) -> None:
    """Stack rows of equal width into a PNG."""
    write_image(path, np.concatenate(rows, axis=0))


def sheet_name(shard: str) -> str:
    """previews/NAME.png of a shard's file name."""
    return f"previews/{Path(shard).stem}.png"


def index_html(title: str, entries: Sequence[ShardEntry]) -> str:
    """A page that shows every sheet; relative links only, no scripts, nothing from the network."""
    columns = " | ".join(COLUMNS)
    parts = [
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{escape(title)}</title>",
        "<style>body{font:15px/1.5 system-ui,sans-serif;margin:2rem;background:#fafafa;color:#222}",
        "img{max-width:100%;image-rendering:pixelated;border:1px solid #ccc}code{background:#eee}</style>",
        f"<h1>{escape(title)}</h1><p>First frame of every clip, AgX at the clip's exposure: {columns} ",
        "(the references in test splits only). See also <a href='card.md'>card.md</a>.</p>",
    ]
    for entry in entries:
        parts.append(
            f"<h2>{escape(entry.name)}</h2><p><code>{escape(', '.join(entry.keys))}</code></p>"
            f"<img src='{escape(sheet_name(entry.name))}' alt='{escape(entry.name)}' loading='lazy'>"
        )
    return "\n".join(parts) + "\n"
