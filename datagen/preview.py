"""Contact sheets: a look at every shard before anybody trains on it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tron.color import linear_to_srgb, to_display
from tron.images import write_image
from tron.shards.schema import MEMBERS, ClipMeta

DEPTHS = ("depth", "depth_ref")  # in world units, which no picture shows
COLUMNS = tuple(name for name in MEMBERS if name not in ("foreground", *DEPTHS))
LARGEST_TILE = 160
GUTTER = 2


def contact_row(meta: ClipMeta, frame: dict[str, np.ndarray]) -> np.ndarray:
    """One frame's members side by side, (H, W', 3) float32 in [0, 1], ready for display.

    Light goes through the clip's exposure and AgX, the rest through :func:`displayable`.
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
        tiles.append(
            np.pad(np.clip(image, 0.0, 1.0), ((0, GUTTER), (0, GUTTER), (0, 0)), constant_values=1.0)
        )
    return np.concatenate(tiles, axis=1)


def is_light(member: str) -> bool:
    """Whether a member is radiance or irradiance, which exposure applies to; base color is neither."""
    return MEMBERS[member].color_space == "linear" and not member.startswith("base_color")


def shown_as_is(meta: ClipMeta, member: str) -> bool:
    """Whether a clip holds a member as display values, as it does photos."""
    return meta.color_space.get(member) == "display"


def displayable(member: str, image: np.ndarray) -> np.ndarray:
    """Display values of a member that is no light, (H, W, C) in [0, 1]: no exposure applies to it.

    Reflectance goes through the sRGB curve, normals through (n + 1) / 2.
    """
    if member.startswith("base_color") or MEMBERS[member].color_space == "reflectance":
        image = np.asarray(linear_to_srgb(np.clip(image, 0.0, 1.0)), np.float32)
    elif member.startswith("normal"):
        image = np.where(np.abs(image).sum(-1, keepdims=True) > 0, 0.5 * image + 0.5, 0.0)
    return np.clip(image, 0.0, 1.0)


def write_sheet(path: Path, rows: Sequence[np.ndarray]) -> None:
    """Stack rows of equal width into a PNG."""
    write_image(path, np.concatenate(rows, axis=0))


def sheet_name(shard: str) -> str:
    """previews/NAME.png of a shard's file name."""
    return f"previews/{Path(shard).stem}.png"
