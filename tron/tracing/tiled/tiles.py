"""Screen tiles: which surfels can touch which 4x4 block of pixels, nearest first.

A tile's 16 pixels fill one 16-lane packet, so every lane of a packet walks the same list. A surfel is a
candidate for a tile if the exact screen-space bounds of its (cut) ellipse, across, down and along both
diagonals, overlap the tile's pixel centres; if it crosses the camera's plane, only the part in front is
bounded. Lists are sorted by ``near = |c - o| - r``, a lower bound of the distance to any point of the surfel,
so that traversal can stop early and stay exact.

Surfels are ordered by ``near`` first and written out tile by tile, so one stable sort by tile orders both.
All of it runs in Dr.Jit; only the number of entries comes back to Python, because arrays need a size.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from tron.cameras import Camera
from tron.errors import TronError
from tron.tracing.kernel import GEOMETRY_PACKETS, T_MIN, SurfelRecords, half_axes

TILE = 4
LANES = TILE * TILE
MARGIN = 1e-2
"""Pixels added around a surfel's bounds, so that rounding adds candidates but never loses one."""
TOUCHING = 1e-4
"""Nearest depth of an ellipse as a share of its farthest; below it, its farther bound is infinite."""
ROUNDING = 1e-6
"""Relative widening of bounds: some units in the last place of a float32."""
MOST_ENTRIES = 1 << 25
"""Most entries of the lists made at once: 50 bytes each, 1.7 GB."""
TINY = 1e-30
SLACK = 0.9999
"""Factor on lower bounds of t, because a ray's own t may be rounded down."""


@dataclass(frozen=True)
class TileLists:
    """Sorted candidate lists of every tile of an image.

    Attributes:
        start, count: mi.UInt32, one entry a tile (row-major): where its list lies in ``entries``.
        entries: mi.UInt32, surfel ids. near: mi.Float, lower bounds of t for the tile's rays; ascending.
    """

    start: mi.UInt32
    count: mi.UInt32
    entries: mi.UInt32
    near: mi.Float


def tile_counts(width: int, height: int) -> tuple[int, int]:
    """Tiles across and down an image; the last ones may hang over its edge."""
    return -(-width // TILE), -(-height // TILE)


def tile_pixels(width: int, height: int) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32, mi.Bool]:
    """Tile, x, y, and whether in the image, in tile order: lane = tile * 16 + pixel within the tile."""
    tiles_x, tiles_y = tile_counts(width, height)
    lane = dr.arange(mi.UInt32, tiles_x * tiles_y * LANES)
    tile, pixel = lane // LANES, lane % LANES
    across, columns, rows = (dr.opaque(mi.UInt32, n) for n in (tiles_x, width, height))
    x = (tile % across) * TILE + pixel % TILE
    y = (tile // across) * TILE + pixel // TILE
    return tile, x, y, (x < columns) & (y < rows)


def lanes_of_pixels(width: int, height: int) -> mi.UInt32:
    """For each pixel in row-major order, its lane in tile order."""
    pixel = dr.arange(mi.UInt32, width * height)
    across, columns = dr.opaque(mi.UInt32, tile_counts(width, height)[0]), dr.opaque(mi.UInt32, width)
    return lane_at(pixel % columns, pixel // columns, across)


def lane_at(x: mi.UInt32, y: mi.UInt32, across: mi.UInt32) -> mi.UInt32:
    """The lane of pixel (x, y) in tile order, with ``across`` tiles side by side."""
    return ((y // TILE) * across + x // TILE) * LANES + (y % TILE) * TILE + x % TILE


@dataclass
class _Touched:
    """Tiles that each surfel's bounds touch, one lane a surfel.

    Attributes:
        first_x, across, first_y: first tile, number of tiles across, first tile down. count: of them all.
        diagonals: mi.Float, four a surfel: lowest and highest pixel x + y, lowest and highest x - y.
        planes: mi.Float, four a surfel: its normal in camera space and the camera's height above its plane.
        near, far: bounds of the distance to any point of the surfel.
    """

    first_x: mi.UInt32
    across: mi.UInt32
    first_y: mi.UInt32
    count: mi.UInt32
    diagonals: mi.Float
    planes: mi.Float
    near: mi.Float
    far: mi.Float


class TooManyEntries(TronError):
    """A camera's tile lists would exceed the allowed number of entries."""


def build_tiles(records: SurfelRecords, camera: Camera, most: int = (1 << 32) - 1) -> TileLists:
    """Make the lists of one camera.

    Args:
        records: the surfels. camera: the view.
        most: largest number of entries, at most what 32-bit indices can address.

    Raises:
        TooManyEntries: the lists would have more.
    """
    tiles_x, tiles_y = tile_counts(camera.width, camera.height)
    bounds = _touched_tiles(records, camera)
    offset = dr.prefix_sum(bounds.count)  # exclusive
    total = int(dr.sum(mi.UInt64(bounds.count))[0])
    if total > most:
        raise TooManyEntries(
            f"{records.count:,} surfels touch {total:,} tiles of 4 x 4 pixels, too many to list",
            mend="render the image in parts, or without surfels as large as the view",
        )
    if total == 0:
        return _no_lists(tiles_x * tiles_y)

    # Each surfel marks its first entry; a running maximum gives every entry its surfel.
    surfel = dr.zeros(mi.UInt32, total)
    dr.scatter(surfel, dr.arange(mi.UInt32, records.count), offset, bounds.count > 0)
    surfel = dr.prefix_reduce(dr.ReduceOp.Max, surfel, exclusive=False)
    within = dr.arange(mi.UInt32, total) - dr.gather(mi.UInt32, offset, surfel)
    width = dr.gather(mi.UInt32, bounds.across, surfel)
    width = dr.select(width > 0, width, 1)  # idle lanes of the last packet: LLVM divides there too
    x = dr.gather(mi.UInt32, bounds.first_x, surfel) + within % width
    y = dr.gather(mi.UInt32, bounds.first_y, surfel) + within // width
    tile = y * dr.opaque(mi.UInt32, tiles_x) + x
    meets = _meets_diagonals(dr.gather(mi.Vector4f, bounds.diagonals, surfel), x, y)
    near = _near_in_tile(bounds, surfel, x, y, camera)
    dr.eval(tile, surfel, meets, near)
    kept = dr.compress(meets)
    if dr.width(kept) == 0:
        return _no_lists(tiles_x * tiles_y)
    tile, surfel = dr.gather(mi.UInt32, tile, kept), dr.gather(mi.UInt32, surfel, kept)
    # One sort orders by tile, then by bound; the bound takes the bits of a key that the tile leaves free.
    levels = min((1 << 32) // (tiles_x * tiles_y), 1 << 31)
    scale = _Levels.of(dr.gather(mi.Float, near, kept), levels)
    levels = dr.opaque(mi.UInt32, levels)
    key = tile * levels + scale.level(dr.gather(mi.Float, near, kept))
    dr.eval(key, surfel)
    position = dr.argsort(key)
    key = dr.gather(mi.UInt32, key, position)
    start, count = _runs(key // levels, tiles_x * tiles_y)
    entries, near = dr.gather(mi.UInt32, surfel, position), scale.near(key % levels)
    dr.eval(start, count, entries, near)
    return TileLists(start, count, entries, near)


def _no_lists(tiles: int) -> TileLists:
    empty = dr.zeros(mi.UInt32, tiles)
    return TileLists(empty, empty, dr.zeros(mi.UInt32, 1), dr.zeros(mi.Float, 1))


def _touched_tiles(records: SurfelRecords, camera: Camera) -> _Touched:
    position = mi.Point3f([float(v) for v in camera.position])
    right, down, forward = (mi.Vector3f([float(v) for v in row]) for row in camera.world_to_camera[:3, :3])
    fx, fy, cx, cy = _opaque(camera.fx, camera.fy, camera.cx, camera.cy)
    columns, rows = _opaque(camera.width, camera.height)
    dr.make_opaque(position, right, down, forward)

    record = dr.arange(mi.UInt32, records.count) * GEOMETRY_PACKETS
    centre, axis_u, axis_v = (dr.gather(mi.Vector4f, records.geometry, record + k) for k in range(3))
    to_centre = mi.Vector3f(centre.x, centre.y, centre.z) - position
    u, v = mi.Vector3f(axis_u.x, axis_u.y, axis_u.z), mi.Vector3f(axis_v.x, axis_v.y, axis_v.z)
    q_cut = axis_v.w
    facing = dr.dot(dr.cross(u, v), to_centre) < 0  # a flat disk shows one side to a point, a filter both
    facing |= records.pixel is not None
    u, v = half_axes(u, v, q_cut)

    def projected(vector: mi.Vector3f) -> mi.Vector3f:
        return mi.Vector3f(fx * dr.dot(right, vector), fy * dr.dot(down, vector), dr.dot(forward, vector))

    c, a, b = projected(to_centre), projected(u), projected(v)
    ahead = c.z + dr.sqrt(a.z * a.z + b.z * b.z) > 0

    def bounds(weights: tuple[int, int], principal: mi.Float) -> tuple[mi.Float, mi.Float]:
        low, high = _screen_bounds(c, a, b, weights, principal)
        if records.pixel is None:
            return low, high
        middle = (weights[0] * c.x + weights[1] * c.y) / c.z + principal
        reach = dr.hypot(weights[0] * fx, weights[1] * fy) * dr.norm(records.pixel)
        reach *= (1 + ROUNDING) * dr.sqrt(dr.maximum(q_cut, 0))
        return dr.minimum(low, middle - reach), dr.maximum(high, middle + reach)

    first_x, across = _tile_range(*bounds((1, 0), cx), columns)
    first_y, down_count = _tile_range(*bounds((0, 1), cy), rows)
    count = dr.select(facing & ahead & (q_cut >= 0), across * down_count, 0)
    distance = dr.norm(to_centre)
    normal = dr.normalize(dr.cross(u, v))
    normal = mi.Vector3f(dr.dot(right, normal), dr.dot(down, normal), dr.dot(forward, normal))
    height = dr.abs(dr.dot(normal, mi.Vector3f(c.x / fx, c.y / fy, c.z)))
    height = dr.maximum(height - ROUNDING * distance, 0)
    near, far = distance - axis_u.w, distance + axis_u.w
    if records.pixel is not None:  # each disk is met at the depth of its centre
        normal, height = mi.Vector3f(0, 0, -1), c.z
        near, far = dr.zeros(mi.Float, records.count), dr.full(mi.Float, dr.inf, records.count)
    planes = dr.zeros(mi.Float, 4 * records.count)
    dr.scatter(planes, mi.Vector4f(*normal, height), dr.arange(mi.UInt32, records.count))
    falling, rising = (bounds((1, sign), cx + sign * cy) for sign in (1, -1))
    diagonals = dr.zeros(mi.Float, 4 * records.count)
    dr.scatter(diagonals, mi.Vector4f(*falling, *rising), dr.arange(mi.UInt32, records.count))
    touched = _Touched(first_x, across, first_y, count, diagonals, planes, near, far)
    dr.eval(touched)
    return touched


def _opaque(*numbers: float) -> tuple[mi.Float, ...]:
    """The camera's numbers as variables: literals would compile a kernel for each view."""
    return tuple(dr.opaque(mi.Float, float(number)) for number in numbers)


def _screen_bounds(
    c: mi.Vector3f, a: mi.Vector3f, b: mi.Vector3f, weights: tuple[int, int], principal: mi.Float
) -> tuple[mi.Float, mi.Float]:
    """Range of a sum of pixel x and y over the part in front (z > 0) of the disk in ``c + a cos + b sin``.

    Vectors are in camera space, x and y times the focal lengths. ``weights`` are the sum's, ``principal`` is
    its value at the principal point; below, x stands for the weighted sum.

    The half axes are turned first, until ``b_z = 0`` and ``a_z >= 0``: then ``c + a`` lies furthest ahead and
    is seen at ``m = (c_x + a_x) / (c_z + a_z)``. The bounds of x/z are sought as offsets d from there. With
    ``e = c_x - m c_z`` and ``h = c_z + a_z``, the plane ``x = (m + d) z`` is tangent to the ellipse where

        (c_z - a_z) h d^2 - 2 e h d - b_x^2 = 0.

    If all of the disk is in front, the roots have opposite signs and are the bounds. A disk that crosses the
    camera's plane projects to one branch of a hyperbola: the root on the side of m away from e is its only
    bound; without roots, it surrounds the axis and is unbounded.
    """
    longest = dr.sqrt(a.z * a.z + b.z * b.z)
    tilted = longest > 0
    cos, sin = dr.select(tilted, a.z / longest, 1), dr.select(tilted, b.z / longest, 0)
    c_x, a_x, b_x = (weights[0] * vector.x + weights[1] * vector.y for vector in (c, a, b))
    a_x, b_x = a_x * cos + b_x * sin, b_x * cos - a_x * sin
    ahead, behind = c.z + longest, c.z - longest
    m = (c_x + a_x) / ahead
    e = c_x - m * c.z
    squared = ahead * (ahead * e * e + behind * b_x * b_x)
    reach = dr.abs(e) * ahead + dr.sqrt(dr.maximum(squared, 0))
    rounding = ROUNDING * (dr.abs(c_x) + dr.abs(a_x) + dr.abs(m) * (dr.abs(c.z) + longest)) / ahead
    near = rounding + dr.select(squared >= 0, b_x * b_x / dr.maximum(reach, TINY), dr.inf)
    # If the ellipse nearly touches the camera's plane, this root is ill-conditioned, and far outside anyway.
    far = reach / (behind * ahead) * (1 + ROUNDING * ahead / behind)
    far = rounding + dr.select(behind > TOUCHING * ahead, far, dr.inf)
    low, high = m - dr.select(e > 0, near, far), m + dr.select(e > 0, far, near)
    return low + principal, high + principal


def _tile_range(low: mi.Float, high: mi.Float, pixels: mi.Float) -> tuple[mi.UInt32, mi.UInt32]:
    """First tile with pixel centres (i + 0.5) in [low, high], and the number of such tiles; 0 for none."""
    first = dr.maximum(dr.ceil(dr.minimum(low - 0.5 - MARGIN, pixels)), 0)
    last = dr.floor(dr.minimum(dr.maximum(high - 0.5 + MARGIN, -1), pixels - 1))
    first_tile = mi.Int(first) // TILE
    tiles = mi.Int(dr.maximum(last, 0)) // TILE - first_tile + 1
    return mi.UInt32(first_tile), mi.UInt32(dr.select(first > last, 0, tiles))


def _meets_diagonals(bounds: mi.Vector4f, x: mi.UInt32, y: mi.UInt32) -> mi.Bool:
    """Whether pixel centres of tile (x, y) lie within bounds of x + y and x - y, which cuts corners off."""
    left, top, reach = mi.Float(x * TILE) + TILE / 2, mi.Float(y * TILE) + TILE / 2, TILE - 1 + 2 * MARGIN
    falling, rising = left + top, left - top
    return (
        (bounds[0] <= falling + reach)
        & (bounds[1] >= falling - reach)
        & (bounds[2] <= rising + reach)
        & (bounds[3] >= rising - reach)
    )


def _near_in_tile(
    bounds: _Touched, surfel: mi.UInt32, x: mi.UInt32, y: mi.UInt32, camera: Camera
) -> mi.Float:
    """Lower bound of t at which rays of tile (x, y) meet the front of a surfel.

    With unit normal n and height h above the plane, a pixel's ray ``d = (d_x, d_y, 1)`` meets it at depth
    ``h / -(n . d)``. The denominator is linear in the pixel, so its maximum lies at a corner of the tile.
    """
    fx, fy, cx, cy = _opaque(camera.fx, camera.fy, camera.cx, camera.cy)
    plane = dr.gather(mi.Vector4f, bounds.planes, surfel)
    dx, dy = (mi.Float(x * TILE) + TILE / 2 - cx) / fx, (mi.Float(y * TILE) + TILE / 2 - cy) / fy
    wide, high = (TILE - 1) / 2 / fx, (TILE - 1) / 2 / fy
    steepest = dr.abs(plane[0]) * wide + dr.abs(plane[1]) * high - plane[0] * dx - plane[1] * dy - plane[2]
    steepest += ROUNDING * (1 + dr.abs(dx) + dr.abs(dy))
    dx, dy = dr.maximum(dr.abs(dx) - wide, 0), dr.maximum(dr.abs(dy) - high, 0)
    on_plane = plane[3] / dr.maximum(steepest, TINY) * dr.sqrt(1 + dx * dx + dy * dy)
    near = dr.minimum(on_plane, dr.gather(mi.Float, bounds.far, surfel))
    return SLACK * dr.maximum(dr.maximum(near, dr.gather(mi.Float, bounds.near, surfel)), T_MIN)


@dataclass
class _Levels:
    """Quantise positive floats to few integers: the leading bits above the smallest float's, rounded down.

    Attributes:
        lowest: mi.UInt32, bits of the smallest number. shift: mi.UInt32, how many low bits are dropped.
    """

    lowest: mi.UInt32
    shift: mi.UInt32

    @staticmethod
    def of(numbers: mi.Float, levels: int) -> _Levels:
        """At most ``levels`` levels for ``numbers``; positive floats are ordered like their bits."""
        bits = dr.reinterpret_array(mi.UInt32, numbers)
        lowest, highest = dr.min(bits), dr.max(bits)
        dr.eval(lowest, highest)
        shift = mi.UInt32(0)
        for k in range(32):
            shift += dr.select(((highest - lowest) >> k) >= dr.opaque(mi.UInt32, levels), mi.UInt32(1), 0)
        return _Levels(lowest, shift)

    def level(self, numbers: mi.Float) -> mi.UInt32:
        """The level of each number, rounded down."""
        return (dr.reinterpret_array(mi.UInt32, numbers) - self.lowest) >> self.shift

    def near(self, level: mi.UInt32) -> mi.Float:
        """The smallest number of each level."""
        return dr.reinterpret_array(mi.Float, (level << self.shift) + self.lowest)


def _runs(keys: mi.UInt32, size: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Start of each of 0..size-1 in sorted ``keys``, and how often it occurs there."""
    i, end = dr.arange(mi.UInt32, dr.width(keys)), dr.opaque(mi.UInt32, dr.width(keys) - 1)
    before = dr.gather(mi.UInt32, keys, dr.select(i > 0, i - 1, 0))
    after = dr.gather(mi.UInt32, keys, dr.select(i < end, i + 1, end))
    first, past = dr.zeros(mi.UInt32, size), dr.zeros(mi.UInt32, size)
    dr.scatter(first, i, keys, (i == 0) | (before != keys))
    dr.scatter(past, i + 1, keys, (i == end) | (after != keys))
    return first, past - first
