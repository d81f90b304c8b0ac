"""A bounding volume hierarchy for arbitrary rays: perfectly balanced, four children per node, no stack.

It is built by median splits of the longest axis, round by round, all parts at once: the surfels of a part are
consecutive, a power of two of them, and one sort by (part, coordinate along the part's longest axis) splits
all parts. Empty places at the end fill up to the power of two. Two rounds make the four children of a node.
The shape of the tree is then arithmetic: with the root numbered 1, the children of node i are 4 i to 4 i + 3,
and nodes from 4^levels on are leaves, in the order of their surfels.

When surfels move, the order stays good for a while and only the boxes are recomputed (:func:`refit`).

A node holds its four children's boxes, not its own, so that one read decides about all four: 12 32-bit words
(three packets) of

    origin x, y, z; step x, y, z; and for each axis the four centres and the four half sizes, a byte each

in steps of 1/250 of the node's own box, half sizes in half steps, rounded outwards, 0 for an empty child. A
grid per node instead of one for the scene costs nothing, and it is fine where the node is small: a stray
surfel coarsens only its ancestors' boxes (compressed wide nodes: Ylitie et al. 2017, "Efficient Incoherent
Ray Traversal on GPUs Through Compressed Wide BVHs"). The ancestors do not coarsen their siblings: a child
much larger than all the others together is visited by every ray, and the grid spans the others only.

Strays are surfels farther from the bulk of the surfels than ``STRAY_SIZES`` times its size. To keep their
ancestors few, they come last in every part that they share with others, and so share the last subtree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi

from tron.tracing.kernel import GEOMETRY_PACKETS, SurfelRecords, half_axes

LEAF_SIZE = 2
CHILDREN = 4
ROUNDS = 2
"""Rounds of splits per level."""
NODE_PACKETS = 3
STEPS = 250.0
"""Steps of a node's own grid along each axis; with rounding and slack a byte holds them."""
EVERYWHERE = 255
"""Half size marking a child that every ray visits: it is ``ALOOF`` times as large as all its siblings."""
ALOOF = 32.0
THICKNESS = 1 / 1024
"""Every surfel's box is widened by this share of its largest extent, so that flat boxes survive float32."""
STRAY_SIZES = 8.0
STRAY_SHARE = 0.01
"""Largest share of the surfels, at each end of each axis, that can be strays."""
_SAMPLE = 4096
_KEY_BITS = 32
_COORDINATE_BITS = 24


@dataclass
class Bvh:
    """The hierarchy and its surfels.

    Attributes:
        nodes: mi.UInt32, ``4 * NODE_PACKETS`` words per node 0 to 4^levels - 1; some are never read.
        first_above_leaves: opaque mi.UInt32 of one lane, 4^(levels - 1): the first node whose children are
            leaves; opaque, so that scenes of any size share one kernel.
        geometry: mi.Float, geometry records in leaf order, padded to a whole leaf.
        order: mi.UInt32 (M,), leaf order -> scene order.
        area: mi.Float of one lane, half surface of all boxes together over the root box's: the expected
            number of boxes met by a random ray that meets the root's (Goldsmith and Salmon 1987).
        levels: levels below the root, 1 or more.
        degree: kernel degree.
    """

    nodes: mi.UInt32
    first_above_leaves: mi.UInt32
    geometry: mi.Float
    order: mi.UInt32
    area: mi.Float
    levels: int
    degree: int


def build_bvh(records: SurfelRecords) -> Bvh:
    """Build the hierarchy of a scene's surfels; a scene may have none."""
    leaves = -(-max(records.count, 1) // LEAF_SIZE)
    rounds = (leaves - 1).bit_length()
    # A root with two children instead of four needs one round fewer.
    return refit(_median_order(records, rounds), max(1, -(-rounds // ROUNDS)), records)


def refit(order: mi.UInt32, levels: int, records: SurfelRecords) -> Bvh:
    """Recompute the boxes and keep the ``order``: quick, exact, and tight while neighbours stay neighbours.

    Args:
        order: (M,) leaf order -> scene order, of an earlier hierarchy of M surfels.
        levels: that hierarchy's levels.
        records: the surfels at their present places.
    """
    places = LEAF_SIZE << (ROUNDS * levels)
    geometry = _in_leaf_order(records, order)
    low, high = _bounds(geometry, records.count, places)
    boxes = []
    while dr.width(low) > 1:  # from surfels over leaves to the root
        low, high = _pairs(low, dr.minimum), _pairs(high, dr.maximum)
        boxes.append((low, high))
    boxes = boxes[::-ROUNDS][: levels + 1]

    words = dr.empty(mi.UInt32, 4 * NODE_PACKETS << (ROUNDS * levels))
    area = mi.Float(0)
    for level, (low, high) in enumerate(boxes):
        if level < levels:
            _write_level(words, level, (low, high), boxes[level + 1])
        area += dr.sum(_half_area(low, high))
    area /= dr.maximum(_half_area(*boxes[0]), 1e-30)
    dr.eval(words, area)
    first = dr.opaque(mi.UInt32, 1 << (ROUNDS * (levels - 1)))
    return Bvh(words, first, geometry, order, area, levels, records.degree)


Box: TypeAlias = "tuple[mi.Vector3f, mi.Vector3f]"
"""Low and high corners of many boxes; low > high where a box is empty."""


def _in_leaf_order(records: SurfelRecords, order: mi.UInt32) -> mi.Float:
    places = -(-max(records.count, 1) // LEAF_SIZE) * LEAF_SIZE
    geometry = dr.empty(mi.Float, 4 * GEOMETRY_PACKETS * places)
    place = dr.arange(mi.UInt32, places)
    # A last leaf with one surfel is padded with a record of negative radius, which no ray meets.
    held = place < dr.opaque(mi.UInt32, records.count)
    source = dr.gather(mi.UInt32, order, place, held)
    for packet in range(GEOMETRY_PACKETS):
        value = dr.gather(mi.Vector4f, dr.detach(records.geometry), source * GEOMETRY_PACKETS + packet)
        value.w = dr.select(held, value.w, -1)
        dr.scatter(geometry, value, place * GEOMETRY_PACKETS + packet)
    dr.eval(geometry)
    return geometry


def _bounds(geometry: mi.Float, count: int, places: int) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Tight boxes of the cut disks; empty (low > high) for empty places and surfels that count nowhere."""
    place = dr.arange(mi.UInt32, places)
    real = place < dr.opaque(mi.UInt32, count)
    centre, u, v = (
        dr.gather(mi.Vector4f, geometry, place * GEOMETRY_PACKETS + k, real) for k in range(GEOMETRY_PACKETS)
    )
    real &= v.w >= 0
    half_u, half_v = half_axes(mi.Vector3f(u.x, u.y, u.z), mi.Vector3f(v.x, v.y, v.z), v.w)
    extent = dr.sqrt(half_u * half_u + half_v * half_v)
    extent += THICKNESS * dr.max(extent)
    middle = mi.Vector3f(centre.x, centre.y, centre.z)
    low, high = dr.select(real, middle - extent, dr.inf), dr.select(real, middle + extent, -dr.inf)
    dr.eval(low, high)
    return low, high


def _pairs(values: mi.Vector3f, reduce: Callable[..., Any]) -> mi.Vector3f:
    """Merge neighbours in pairs."""
    even = 2 * dr.arange(mi.UInt32, dr.width(values) // 2)
    left, right = (mi.Vector3f(*[dr.gather(mi.Float, v, even + side) for v in values]) for side in (0, 1))
    result = reduce(left, right)
    dr.eval(result)
    return result


def _half_area(low: mi.Vector3f, high: mi.Vector3f) -> mi.Float:
    size = mi.Vector3f(dr.maximum(high - low, 0))
    return size.x * size.y + size.y * size.z + size.z * size.x


def _write_level(words: mi.UInt32, level: int, box: Box, children: Box) -> None:
    """Write the nodes of one level: the boxes of their children, quantised outwards."""
    node = dr.arange(mi.UInt32, 1 << (ROUNDS * level))
    inner = [
        tuple(
            mi.Vector3f(*[dr.gather(mi.Float, v, CHILDREN * node + child) for v in bound])
            for bound in children
        )
        for child in range(CHILDREN)
    ]
    low, high = box
    aloof = [mi.Bool(False)] * CHILDREN
    for child in range(CHILDREN):
        others = inner[:child] + inner[child + 1 :]
        rest_low, rest_high = others[0]
        for first, last in others[1:]:
            rest_low, rest_high = dr.minimum(rest_low, first), dr.maximum(rest_high, last)
        size = dr.max(inner[child][1] - inner[child][0])
        aloof[child] = (rest_low.x <= rest_high.x) & (size > ALOOF * dr.max(rest_high - rest_low))
        low, high = dr.select(aloof[child], rest_low, low), dr.select(aloof[child], rest_high, high)
    real = low.x <= high.x
    origin = dr.select(real, low, 0)
    step = dr.select(real, (high - low) / STEPS, 1)
    centres, halves = mi.Vector3u(0), mi.Vector3u(0)
    for child, (first, last) in enumerate(inner):
        filled = first.x <= last.x
        middle = dr.select(filled, 0.5 * (first + last) - origin, 0)
        centre = dr.clip(dr.round(middle / step), 0, 255)
        reach = dr.maximum(0.5 * (last - first), 0) + dr.abs(middle - centre * step)
        # Half a step of slack covers the float32 rounding of this quantisation.
        half = dr.clip(dr.ceil(2 * reach / step) + 1, 1, EVERYWHERE - 1)
        half = dr.select(aloof[child], EVERYWHERE, half)
        centres |= mi.Vector3u(centre) << (8 * child)
        halves |= dr.select(filled, mi.Vector3u(half), 0) << (8 * child)
    origin, step = (mi.Vector3u(dr.reinterpret_array(mi.Vector3u, v)) for v in (origin, step))
    record = (dr.opaque(mi.UInt32, 1 << (ROUNDS * level)) + node) * NODE_PACKETS
    packets = (
        mi.Vector4u(origin.x, origin.y, origin.z, step.x),
        mi.Vector4u(step.y, step.z, centres.x, halves.x),
        mi.Vector4u(centres.y, halves.y, centres.z, halves.z),
    )
    for packet, value in enumerate(packets):
        dr.scatter(words, value, record + packet)


def _median_order(records: SurfelRecords, rounds: int) -> mi.UInt32:
    """Leaf order -> scene order: ``rounds`` of median splits, all parts in one sort."""
    places = LEAF_SIZE << rounds
    order = dr.arange(mi.UInt32, places)
    near_low, near_high = _bulk(records)
    for done in range(rounds):
        dr.eval(order)
        real = order < dr.opaque(mi.UInt32, records.count)
        centre = dr.gather(mi.Vector4f, dr.detach(records.geometry), order * GEOMETRY_PACKETS, real)
        centre = mi.Vector3f(centre.x, centre.y, centre.z)
        stray = real & dr.any((centre < near_low) | (centre > near_high))
        size = places >> done
        ordinary, strays = (_extent(centre, which, size) for which in (real & ~stray, stray))
        alone = ordinary[0].x > ordinary[1].x
        low, high = (dr.select(alone, b, a) for a, b in zip(ordinary, strays))
        dr.eval(centre, real, stray, alone, low, high)
        shift = dr.opaque(mi.UInt32, (places >> done).bit_length() - 1)
        bits = min(_KEY_BITS - done, _COORDINATE_BITS)
        keys = _keys(centre, real, stray, alone, (low, high), shift, dr.opaque(mi.UInt32, bits))
        order = dr.gather(mi.UInt32, order, dr.argsort(keys))
    return dr.gather(mi.UInt32, order, dr.arange(mi.UInt32, records.count))


def _bulk(records: SurfelRecords) -> Box:
    """Box outside which a surfel is a stray, from the bounds of all but ``STRAY_SHARE`` of a sample."""
    count = min(max(records.count, 1), _SAMPLE)
    sample = dr.arange(mi.UInt32, count) * dr.opaque(mi.UInt32, max(records.count, 1) // count)
    centre = dr.gather(mi.Vector4f, dr.detach(records.geometry), sample * GEOMETRY_PACKETS)
    ends = [
        dr.opaque(mi.UInt32, end) for end in (int(STRAY_SHARE * count), count - 1 - int(STRAY_SHARE * count))
    ]
    low, high = mi.Vector3f(0), mi.Vector3f(0)
    for axis in range(3):
        dr.eval(centre[axis])
        ascending = dr.gather(mi.Float, centre[axis], dr.argsort(centre[axis]))
        low[axis], high[axis] = (dr.gather(mi.Float, ascending, end) for end in ends)
    margin = STRAY_SIZES * dr.max(high - low)
    low, high = low - margin, high + margin
    dr.eval(low, high)
    return low, high


def _extent(centre: mi.Vector3f, which: mi.Bool, size: int) -> Box:
    """Bounding boxes of the selected centres in each part of ``size`` places."""
    low, high = dr.select(which, centre, dr.inf), dr.select(which, centre, -dr.inf)
    dr.eval(low, high)
    return _reduce(dr.ReduceOp.Min, low, size), _reduce(dr.ReduceOp.Max, high, size)


def _reduce(op: dr.ReduceOp, values: mi.Vector3f, size: int) -> mi.Vector3f:
    return mi.Vector3f(*[dr.block_reduce(op, value, size) for value in values])


def _keys(
    centre: mi.Vector3f,
    real: mi.Bool,
    stray: mi.Bool,
    alone: mi.Bool,
    box: Box,
    shift: mi.UInt32,
    bits: mi.UInt32,
) -> mi.UInt32:
    """Sort keys: the part in the high bits, the coordinate on its longest axis in the ``bits`` low ones.

    Args:
        centre: of the surfel at each place. real: the place is not empty. stray: its surfel is a stray.
        alone: (parts,) the part holds strays only. box: (parts,) of its other surfels; of strays, if alone.
        shift: log2 of a part's number of places.
    """
    part = dr.arange(mi.UInt32, dr.width(centre)) >> shift
    low, high = (mi.Vector3f(*[dr.gather(mi.Float, v, part) for v in bound]) for bound in box)
    size = high - low
    on_x = (size.x >= size.y) & (size.x >= size.z)
    on_y = ~on_x & (size.y >= size.z)

    def pick(v: mi.Vector3f) -> mi.Float:
        return dr.select(on_x, v.x, dr.select(on_y, v.y, v.z))

    most = (mi.UInt32(1) << bits) - 3
    share = dr.clip((pick(centre) - pick(low)) / dr.maximum(pick(size), 1e-30), 0, 1)
    coordinate = dr.minimum(mi.UInt32(share * mi.Float(most)), most)
    # Strays come after the other surfels of their part, and empty places last.
    coordinate = dr.select(stray & ~dr.gather(mi.Bool, alone, part), most + 1, coordinate)
    return (part << bits) | dr.select(real, coordinate, most + 2)
