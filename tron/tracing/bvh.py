"""A bounding volume hierarchy for arbitrary rays: perfectly balanced, threaded with skip links, no stack.

Built by median splits of the longest axis, round by round, all parts at once: the surfels of a part are
neighbours in the order, a power of two of them, and one sort by (part, coordinate along the part's longest
axis) splits them all. What is missing to a power of two stands at the end as empty places. Two rounds make
the four children of a node: rays that meet a box meet most of its halves, so testing the quarters at once
costs less. Then the shape of the tree is arithmetic: node i of level l of a tree with L levels below the root
has the depth-first index l + (i 4^(L - l + 1) - s) / 3, s the sum of i's digits in base 4; its first child is
the next node, and its skip link (where to go when the box is missed, or after a leaf) is itself plus the size
of its subtree, (4^(L - l + 1) - 1) / 3.

When surfels move, the order stays good for a while and the boxes alone are made anew (:func:`refit`).

A node is four 32-bit words: six 16-bit bounds on a grid over the scene, rounded outwards, and the skip link
or leaf word. Four words are one packet; float bounds took 2.7 times as long (tracer.md).
"""

# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false, reportReturnType=false
# (Mitsuba's type stubs know neither arithmetic between its own array types nor its aliases of Dr.Jit's.)

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from tron.tracing.kernel import GEOMETRY_PACKETS, SurfelRecords, half_axes

LEAF_SIZE = 2
CHILDREN = 4
ROUNDS = 2
"""Rounds of splits to a level."""
LEAF_BIT = 1 << 31
_GRID = 65533.0
_KEY_BITS = 32
_COORDINATE_BITS = 24


@dataclass
class Bvh:
    """The hierarchy and its surfels.

    Attributes:
        nodes: mi.UInt32, 4 words a node in depth-first order: (low | high << 16) for x, y, z, and the link.
            The link of an inner node is the node to skip to; of a leaf, ``LEAF_BIT | first << 4 | count``.
        node_count: opaque mi.UInt32 of one lane, so that scenes of any size share one kernel.
        geometry: mi.Float, geometry records in leaf order.
        order: mi.UInt32 (M,), leaf order -> scene order.
        grid_origin, grid_scale: one lane each; world -> grid coordinates.
        area: mi.Float of one lane, summed half surface of all boxes over the root's: how many boxes a random
            ray that meets the root's is expected to meet (Goldsmith and Salmon 1987).
        levels: levels below the root.
        degree: kernel degree.
    """

    nodes: mi.UInt32
    node_count: mi.UInt32
    geometry: mi.Float
    order: mi.UInt32
    grid_origin: mi.Point3f
    grid_scale: mi.Vector3f
    area: mi.Float
    levels: int
    degree: int


def build_bvh(records: SurfelRecords) -> Bvh:
    """Build the hierarchy of a scene's surfels, none included."""
    leaves = -(-max(records.count, 1) // LEAF_SIZE)
    rounds = (leaves - 1).bit_length()
    # Where the root has two children of its four, the round that would make the others has nothing to split.
    return refit(_median_order(records, rounds), -(-rounds // ROUNDS), records)


def refit(order: mi.UInt32, levels: int, records: SurfelRecords) -> Bvh:
    """Boxes for surfels that keep their ``order``; quick, exact, and tight while neighbours stay neighbours.

    Args:
        order: (M,) leaf order -> scene order, of an earlier hierarchy of M surfels.
        levels: that hierarchy's levels.
        records: the surfels where they are now.
    """
    places = LEAF_SIZE << (ROUNDS * levels)
    geometry = _in_leaf_order(records, order)
    low, high = _bounds(geometry, records.count, places)
    boxes = []
    while dr.width(low) > 1:  # from surfels over leaves to the root
        low, high = _pairs(low, dr.minimum), _pairs(high, dr.maximum)
        boxes.append((low, high))
    boxes = boxes[::-ROUNDS][: levels + 1]

    root_low, root_high = boxes[0]
    size = root_high - root_low
    # A flat scene needs cells wider than the rounding of its rays, a scene without surfels any cells at all.
    pad = 0.03 * dr.maximum(dr.max(size), 1e-6)
    origin = mi.Point3f(dr.select(size >= 0, root_low - pad, 0))
    scale = dr.select(size >= 0, _GRID / (size + 2 * pad), 1)
    dr.eval(origin, scale)

    nodes = ((CHILDREN << (ROUNDS * levels)) - 1) // (CHILDREN - 1)
    words = dr.empty(mi.UInt32, 4 * nodes)
    area = mi.Float(0)
    for level, (low, high) in enumerate(boxes):
        _write_level(words, level, levels, records.count, low, high, origin, scale)
        area += dr.sum(_half_area(low, high))
    area /= dr.maximum(_half_area(root_low, root_high), 1e-30)
    dr.eval(words, area)
    return Bvh(
        words,
        dr.opaque(mi.UInt32, nodes),
        geometry,
        order,
        origin,
        scale,
        area,
        levels,
        records.degree,
    )


def _in_leaf_order(records: SurfelRecords, order: mi.UInt32) -> mi.Float:
    geometry = dr.empty(mi.Float, max(dr.width(records.geometry), 4 * GEOMETRY_PACKETS))
    place = dr.arange(mi.UInt32, records.count)
    for packet in range(GEOMETRY_PACKETS):
        value = dr.gather(mi.Vector4f, dr.detach(records.geometry), order * GEOMETRY_PACKETS + packet)
        dr.scatter(geometry, value, place * GEOMETRY_PACKETS + packet)
    dr.eval(geometry)
    return geometry


def _bounds(geometry: mi.Float, count: int, places: int) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Tight boxes of the cut disks; empty (low > high) for surfels that count nowhere and empty places."""
    place = dr.arange(mi.UInt32, places)
    real = place < dr.opaque(mi.UInt32, count)
    centre, u, v = (
        dr.gather(mi.Vector4f, geometry, place * GEOMETRY_PACKETS + k, real) for k in range(GEOMETRY_PACKETS)
    )
    real &= v.w >= 0
    half_u, half_v = half_axes(mi.Vector3f(u.x, u.y, u.z), mi.Vector3f(v.x, v.y, v.z), v.w)
    extent = dr.sqrt(half_u * half_u + half_v * half_v)
    middle = mi.Vector3f(centre.x, centre.y, centre.z)
    low, high = dr.select(real, middle - extent, dr.inf), dr.select(real, middle + extent, -dr.inf)
    dr.eval(low, high)
    return low, high


def _pairs(values: mi.Vector3f, reduce: object) -> mi.Vector3f:
    """Reduce neighbours two by two."""
    even = 2 * dr.arange(mi.UInt32, dr.width(values) // 2)
    left, right = (mi.Vector3f(*[dr.gather(mi.Float, v, even + side) for v in values]) for side in (0, 1))
    result = reduce(left, right)
    dr.eval(result)
    return result


def _half_area(low: mi.Vector3f, high: mi.Vector3f) -> mi.Float:
    size = dr.maximum(high - low, 0)
    return size.x * size.y + size.y * size.z + size.z * size.x


def _write_level(
    words: mi.UInt32,
    level: int,
    levels: int,
    count: int,
    low: mi.Vector3f,
    high: mi.Vector3f,
    origin: mi.Point3f,
    scale: mi.Vector3f,
) -> None:
    """Quantise the boxes of one level outwards and write its nodes."""
    node = dr.arange(mi.UInt32, 1 << (ROUNDS * level))
    depth, below = dr.opaque(mi.UInt32, level), dr.opaque(mi.UInt32, levels - level)
    digits = mi.UInt32(dr.popcnt(node & 0x55555555)) + 2 * mi.UInt32(dr.popcnt(node & 0xAAAAAAAA))
    index = depth + ((node << (ROUNDS * (below + 1))) - digits) // 3
    size = ((mi.UInt32(CHILDREN) << (ROUNDS * below)) - 1) // 3
    # One cell of slack on each side covers the float32 rounding of the rays' grid coordinates.
    first = mi.Vector3u(dr.clip(dr.floor((low - origin) * scale) - 1, 0, 65535))
    last = mi.Vector3u(dr.clip(dr.ceil((high - origin) * scale) + 1, 0, 65535))
    surfel = node * LEAF_SIZE
    total = dr.opaque(mi.UInt32, count)
    held = dr.select(surfel < total, dr.minimum(total - surfel, LEAF_SIZE), 0)
    # An empty box is the grid's far corner, a point. One with low > high would be met by every ray: the slab
    # test sorts the two bounds.
    empty = ~(low.x <= high.x)
    bounds = [dr.select(empty, mi.UInt32(0xFFFFFFFF), a | (b << 16)) for a, b in zip(first, last)]
    link = dr.select(below == 0, mi.UInt32(LEAF_BIT) | (surfel << 4) | held, index + size)
    dr.scatter(words, mi.Vector4u(*bounds, link), index)


def _median_order(records: SurfelRecords, rounds: int) -> mi.UInt32:
    """Leaf order -> scene order: ``rounds`` of median splits, all parts in one sort."""
    places = LEAF_SIZE << rounds
    order = dr.arange(mi.UInt32, places)
    for done in range(rounds):
        dr.eval(order)
        real = order < dr.opaque(mi.UInt32, records.count)
        centre = dr.gather(mi.Vector4f, dr.detach(records.geometry), order * GEOMETRY_PACKETS, real)
        centre = mi.Vector3f(centre.x, centre.y, centre.z)
        low, high = dr.select(real, centre, dr.inf), dr.select(real, centre, -dr.inf)
        dr.eval(centre, real, low, high)
        size = places >> done
        low, high = _reduce(dr.ReduceOp.Min, low, size), _reduce(dr.ReduceOp.Max, high, size)
        shift = dr.opaque(mi.UInt32, (places >> done).bit_length() - 1)
        bits = min(_KEY_BITS - done, _COORDINATE_BITS)
        order = dr.gather(
            mi.UInt32, order, dr.argsort(_keys(centre, real, low, high, shift, dr.opaque(mi.UInt32, bits)))
        )
    return dr.gather(mi.UInt32, order, dr.arange(mi.UInt32, records.count))


def _reduce(op: dr.ReduceOp, values: mi.Vector3f, size: int) -> mi.Vector3f:
    return mi.Vector3f(*[dr.block_reduce(op, value, size) for value in values])


def _keys(
    centre: mi.Vector3f, real: mi.Bool, low: mi.Vector3f, high: mi.Vector3f, shift: mi.UInt32, bits: mi.UInt32
) -> mi.UInt32:
    """Sort keys: the part in the high bits, the coordinate on its longest axis in the ``bits`` low ones."""
    part = dr.arange(mi.UInt32, dr.width(centre)) >> shift
    low, high = (mi.Vector3f(*[dr.gather(mi.Float, v, part) for v in bound]) for bound in (low, high))
    size = high - low
    on_x = (size.x >= size.y) & (size.x >= size.z)
    on_y = ~on_x & (size.y >= size.z)

    def pick(v: mi.Vector3f) -> mi.Float:
        return dr.select(on_x, v.x, dr.select(on_y, v.y, v.z))

    steps = mi.Float((mi.UInt32(1) << bits) - 2)
    share = dr.clip((pick(centre) - pick(low)) / dr.maximum(pick(size), 1e-30), 0, 1)
    coordinate = dr.minimum(mi.UInt32(share * steps), mi.UInt32(steps))
    # Empty places come last in their part.
    return (part << bits) | dr.select(real, coordinate, (mi.UInt32(1) << bits) - 1)
