"""Screen tiles: which surfels can touch which 4x4 block of pixels, nearest first.

A tile's 16 pixels fill one 16-lane packet, so every lane of a packet walks the same list. A surfel is a
candidate for a tile where the exact screen-space bounds of its (cut) ellipse overlap the tile's pixel
centres. Lists are sorted by ``near = |c - o| - r``, a lower bound of the distance to any point of the
surfel, which lets traversal stop early without being wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from tron.cameras import Camera

TILE = 4
LANES = TILE * TILE


@dataclass(frozen=True)
class TileLists:
    """Sorted candidate lists of every tile of an image.

    Attributes:
        start, count: mi.UInt32, one entry a tile (row-major): where its list lies in ``entries``.
        entries: mi.UInt32, surfel ids.
        tiles_x, tiles_y: tiles across and down; the last ones may hang over the image's edge.
    """

    start: mi.UInt32
    count: mi.UInt32
    entries: mi.UInt32
    tiles_x: int
    tiles_y: int


def _screen_bounds(
    centre: np.ndarray, axis_a: np.ndarray, axis_b: np.ndarray, k: int, focal: float, principal: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pixel range of the ellipses ``c + a cos + b sin`` along image axis k; unbounded where z = 0 is crossed.

    The bounds of x/z over the ellipse are the roots m at which the plane x = m z is tangent to it:
    ``(c_x - m c_z)^2 = (a_x - m a_z)^2 + (b_x - m b_z)^2``.
    """
    in_front = centre[:, 2] ** 2 - axis_a[:, 2] ** 2 - axis_b[:, 2] ** 2
    cross = centre[:, k] * centre[:, 2] - axis_a[:, k] * axis_a[:, 2] - axis_b[:, k] * axis_b[:, 2]
    constant = centre[:, k] ** 2 - axis_a[:, k] ** 2 - axis_b[:, k] ** 2
    clear = (in_front > 0) & (centre[:, 2] > 0)
    root = np.sqrt(np.maximum(cross**2 - in_front * constant, 0.0))
    divisor = np.where(clear, in_front, 1.0)
    low, high = (cross - root) / divisor, (cross + root) / divisor
    return (
        np.where(clear, focal * low + principal, -np.inf),
        np.where(clear, focal * high + principal, np.inf),
    )


def _tile_range(low: np.ndarray, high: np.ndarray, pixels: int, tiles: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last tile with pixel centres (i + 0.5) in [low, high]; first > last where there are none."""
    margin = 1e-2  # pixels; candidates may be too many, never too few
    first = np.ceil(np.clip(low - 0.5 - margin, -1.0, pixels + 1.0))
    last = np.floor(np.clip(high - 0.5 + margin, -2.0, pixels))
    first, last = np.maximum(first, 0.0), np.minimum(last, pixels - 1.0)
    empty = first > last
    first_tile = np.minimum(first // TILE, tiles - 1).astype(np.int64)
    last_tile = (last // TILE).astype(np.int64)
    return first_tile, np.where(empty, first_tile - 1, last_tile)


def build_tiles(geometry: np.ndarray, camera: Camera) -> TileLists:
    """Make the lists of one camera.

    Args:
        geometry: (M, 12) float32 records of :func:`tron.tracing.kernel.pack_geometry`.
        camera: pinhole camera.
    """
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    rotation = camera.world_to_camera[:3, :3]
    # float32 records, float64 projection: the bounds must not round inwards.
    to_centre = geometry[:, 0:3].astype(np.float64) - camera.position
    axis_u, axis_v = geometry[:, 4:7].astype(np.float64), geometry[:, 8:11].astype(np.float64)
    q_cut = geometry[:, 11].astype(np.float64)
    facing = (np.cross(axis_u, axis_v) * to_centre).sum(1) < 0  # a flat disk shows one side to a point
    reach = np.sqrt(np.maximum(q_cut, 0.0))
    # t_u / s_u has length 1 / s_u: dividing by its squared length gives s_u t_u.
    half_u = axis_u * (reach / np.maximum((axis_u**2).sum(1), 1e-30))[:, None] @ rotation.T
    half_v = axis_v * (reach / np.maximum((axis_v**2).sum(1), 1e-30))[:, None] @ rotation.T
    centre = to_centre @ rotation.T
    ahead = centre[:, 2] + np.sqrt(half_u[:, 2] ** 2 + half_v[:, 2] ** 2) > 0
    x0, x1 = _tile_range(
        *_screen_bounds(centre, half_u, half_v, 0, camera.fx, camera.cx), camera.width, tiles_x
    )
    y0, y1 = _tile_range(
        *_screen_bounds(centre, half_u, half_v, 1, camera.fy, camera.cy), camera.height, tiles_y
    )
    across, down = np.maximum(x1 - x0 + 1, 0), np.maximum(y1 - y0 + 1, 0)
    touched = np.where(facing & ahead & (q_cut >= 0), across * down, 0)

    near = np.linalg.norm(to_centre, axis=1) - geometry[:, 7]
    order = np.argsort(
        near, kind="stable"
    )  # emit surfels nearest first: one stable sort by tile then orders both
    surfel = np.repeat(order, touched[order])
    within = np.arange(len(surfel)) - np.repeat(np.cumsum(touched[order]) - touched[order], touched[order])
    tile = (y0[surfel] + within // across[surfel]) * tiles_x + x0[surfel] + within % across[surfel]
    sort = np.argsort(tile.astype(np.uint32), kind="stable")
    count = np.bincount(tile, minlength=tiles_x * tiles_y)
    return TileLists(
        start=mi.UInt32((np.cumsum(count) - count).astype(np.uint32)),
        count=mi.UInt32(count.astype(np.uint32)),
        entries=mi.UInt32(surfel[sort].astype(np.uint32) if len(surfel) else np.zeros(1, np.uint32)),
        tiles_x=tiles_x,
        tiles_y=tiles_y,
    )
