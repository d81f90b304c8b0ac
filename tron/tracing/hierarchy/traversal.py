"""Traversal of the hierarchy: visit the surfels near some rays, in any order.

A lane carries a fan of rays from one point. They share each node read, which takes most of the time: four
rays in neighbouring directions take little more than half as long as four single rays.

No stack is kept: a word of four bits a level says which nodes are still to be visited (:class:`Descent`).

Lanes search for leaves independently but meet surfels together: each lane collects leaves for a few steps,
and then all lanes meet the surfels of a few leaves. Otherwise one lane in a leaf would keep fifteen waiting
at nearly every node (Aila and Laine 2009, "Understanding the Efficiency of Ray Traversal on GPUs").
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import drjit as dr
import mitsuba as mi

from tron.tracing.hierarchy.bvh import CHILDREN, EVERYWHERE, LEAF_SIZE, NODE_PACKETS, Bvh

NODES_A_TURN = 6
LEAVES_A_TURN = 4
_GROUPS = 3
"""Groups of leaves, each under one node, that a lane can hold."""
_ROOT = 2
"""Initial value of ``pending``: the root is child 1 of a node 0 that does not exist."""
_TINY = 1e-12
_ROUNDING = 1 + 2.0**-21
"""Covers the float32 rounding of distances (Ize 2013, "Robust BVH Ray Traversal")."""


class Intervals(Protocol):
    """State of a walk: at least the interval of distance within which surfels can still matter.

    Attributes:
        nearest, farthest: one per ray, world units along the unit ray; a ray is done once farthest is minus
            infinity, and the walk is done once all its rays are.
    """

    nearest: list[mi.Float]
    farthest: list[mi.Float]


State = TypeVar("State", bound=Intervals)


def _smaller(a: mi.Float, b: mi.Float) -> mi.Float:
    return dr.select(a < b, a, b)


def _larger(a: mi.Float, b: mi.Float) -> mi.Float:
    return dr.select(a > b, a, b)


def any_of(masks: Sequence[mi.Bool]) -> mi.Bool:
    """Lanes in which any of the masks is set."""
    found = mi.Bool(masks[0])
    for mask in masks[1:]:
        found = found | mask
    return found


@dataclass
class Descent:
    """State of a lane's walk.

    Attributes:
        node: the node visited last.
        pending: nodes still to be visited, four bits a level: ``node``'s children lowest, then its siblings,
            and so on upwards. Seventeen levels fit.
        groups: leaves found but not yet visited, last found first: 16 times the number of their parent,
            counted from the first parent of leaves, plus one bit for each child; 0 for none.
    """

    node: mi.UInt32
    pending: mi.UInt64
    groups: list[mi.UInt32]

    @staticmethod
    def begun() -> Descent:
        """A walk about to visit the root."""
        return Descent(mi.UInt32(0), mi.UInt64(_ROOT), [mi.UInt32(0) for _ in range(_GROUPS)])

    def unfinished(self, state: Intervals) -> mi.Bool:
        """Lanes with nodes left to visit and a ray that is not done."""
        return ((self.pending != 0) | (self.groups[0] != 0)) & any_of([f > -dr.inf for f in state.farthest])


def slopes_of(direction: mi.Vector3f) -> mi.Vector3f:
    """1 / direction, finite."""
    return dr.rcp(mi.Vector3f(*[dr.select(dr.abs(v) < _TINY, _TINY, v) for v in direction]))


@dr.syntax
def walk(
    bvh: Bvh,
    origin: mi.Point3f,
    directions: Sequence[mi.Vector3f],
    state: State,
    visit: Callable[[State, mi.UInt32, mi.Bool], State],
    active: mi.Bool,
) -> State:
    """Visit every surfel whose box meets a ray of the fan within its ``[nearest, farthest]``.

    Args:
        bvh: the hierarchy.
        origin: world, of all rays of a lane. directions: unit, world.
        state: carried through the walk; narrowing its intervals shortens the walk.
        visit: called with the state, a surfel in the hierarchy's order, and the lanes that visit it.
        active: lanes that walk.
    """
    slopes = [slopes_of(direction) for direction in directions]
    at = Descent.begun()
    going = mi.Bool(active)
    while going:
        at = search(bvh, origin, slopes, state, at, going)
        at, state = look(at, state, visit, going)
        going &= at.unfinished(state)
    return state


@dr.syntax
def search(
    bvh: Bvh,
    origin: mi.Point3f,
    slopes: Sequence[mi.Vector3f],
    state: Intervals,
    at: Descent,
    active: mi.Bool,
) -> Descent:
    """Collect leaves, for ``NODES_A_TURN`` nodes or until a lane's slots are full."""
    passed = mi.UInt32(0)
    searching = active & (at.groups[-1] == 0) & (at.pending != 0)
    while searching:
        lowest = mi.UInt32(dr.tzcnt(at.pending))
        up = lowest >> 2
        pending = at.pending >> mi.UInt64(up << 2)
        at.node = ((at.node >> (up << 1)) << 2) | (lowest & 3)
        children = _met_children(bvh, at.node, origin, slopes, state, searching)
        leaves = dr.select(at.node >= bvh.first_above_leaves, children, 0)
        at.pending = ((pending & (pending - 1)) << CHILDREN) | mi.UInt64(children - leaves)
        group = ((at.node - bvh.first_above_leaves) << CHILDREN) | leaves
        for k in range(_GROUPS - 1, 0, -1):
            at.groups[k] = dr.select(leaves != 0, at.groups[k - 1], at.groups[k])
        at.groups[0] = dr.select(leaves != 0, group, at.groups[0])
        passed += 1
        searching &= (at.groups[-1] == 0) & (at.pending != 0) & (passed < NODES_A_TURN)
    return at


@dr.syntax
def look(
    at: Descent, state: State, visit: Callable[[State, mi.UInt32, mi.Bool], State], active: mi.Bool
) -> tuple[Descent, State]:
    """Visit the surfels of up to ``LEAVES_A_TURN`` of the leaves collected."""
    passed = mi.UInt32(0)
    looking = active & (at.groups[0] != 0)
    while looking:
        group = at.groups[0]
        leaf = ((group >> CHILDREN) << 2) + mi.UInt32(dr.tzcnt(group))
        for k in range(LEAF_SIZE):
            state = visit(state, LEAF_SIZE * leaf + k, looking)
        left = group & (group - 1)
        more = (left & 15) != 0
        at.groups[0] = dr.select(more, left, at.groups[1])
        for k in range(1, _GROUPS):
            behind = at.groups[k + 1] if k + 1 < _GROUPS else mi.UInt32(0)
            at.groups[k] = dr.select(more, at.groups[k], behind)
        passed += 1
        looking = (at.groups[0] != 0) & (passed < LEAVES_A_TURN)
    return at, state


def _met_children(
    bvh: Bvh,
    node: mi.UInt32,
    origin: mi.Point3f,
    slopes: Sequence[mi.Vector3f],
    state: Intervals,
    active: mi.Bool,
) -> mi.UInt32:
    """Four bits: the children whose boxes a ray of the fan meets within its interval."""
    packets = [
        dr.gather(mi.Vector4u, bvh.nodes, node * NODE_PACKETS + packet, active)
        for packet in range(NODE_PACKETS)
    ]
    words = [word for packet in packets for word in packet]
    low = mi.Vector3f(*[dr.reinterpret_array(mi.Float, word) for word in words[:3]]) - origin
    step = mi.Vector3f(*[dr.reinterpret_array(mi.Float, word) for word in words[3:6]])
    boxes = [
        [
            mi.Vector3f(*[mi.Float((word >> (8 * child)) & 0xFF) for word in words[which::2]])
            for which in (6, 7)
        ]
        for child in range(CHILDREN)
    ]
    hits: list[list[mi.Bool]] = [[] for _ in range(CHILDREN)]
    for slope, nearest, farthest in zip(slopes, state.nearest, state.farthest):
        offset, scale = low * slope, slope * step
        reach = 0.5 * dr.abs(scale)
        for found, (centre, half) in zip(hits, boxes):
            middle, aside = dr.fma(centre, scale, offset), half * reach
            first, last = middle - aside, middle + aside
            enter = _larger(_larger(first.x, first.y), first.z)
            leave = _ROUNDING * _smaller(_smaller(last.x, last.y), last.z)
            found.append((enter <= leave) & (enter <= farthest) & (leave >= nearest))
    bits = mi.UInt32(0)
    for child, (found, (_, half)) in enumerate(zip(hits, boxes)):
        visited = (any_of(found) & (half.x > 0)) | (half.x == EVERYWHERE)
        bits |= dr.select(visited, mi.UInt32(1 << child), 0)
    return bits
