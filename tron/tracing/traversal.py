"""The walk through the hierarchy, for whoever wants to visit the surfels near some rays, in any order.

A lane carries a fan of rays from one point. They share each node that is read, which is what a walk spends
its time on: four rays of neighbouring directions together take little more than half the time of four alone.

Lanes look for leaves at their own pace but meet the surfels of leaves together: a few nodes are passed first,
until a leaf is found, and only then are the surfels of those that found one looked at. One lane in a leaf
would otherwise keep fifteen waiting at nearly every node (1.4 times as fast with some nodes between; Aila and
Laine 2009, "Understanding the Efficiency of Ray Traversal on GPUs").
"""

# pyright: reportOperatorIssue=false, reportArgumentType=false
# (Mitsuba's type stubs know neither arithmetic between its own array types nor its aliases of Dr.Jit's.)

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import drjit as dr
import mitsuba as mi

from tron.tracing.bvh import LEAF_BIT, Bvh

NODES_BETWEEN_LEAVES = 6


class Intervals(Protocol):
    """What a walk carries along: at least the distances between which surfels can still matter.

    Attributes:
        nearest, farthest: one of each a ray, world units along the unit ray; a ray is done once nearest >
            farthest, and the walk once all are.
    """

    nearest: list[mi.Float]
    farthest: list[mi.Float]


State = TypeVar("State", bound=Intervals)


def _smaller(a: mi.Float, b: mi.Float) -> mi.Float:
    return dr.select(a < b, a, b)


def _larger(a: mi.Float, b: mi.Float) -> mi.Float:
    return dr.select(a > b, a, b)


def _any(masks: Sequence[mi.Bool]) -> mi.Bool:
    found = masks[0]
    for mask in masks[1:]:
        found = found | mask
    return found


def _unfinished(state: Intervals) -> list[mi.Bool]:
    return [nearest <= farthest for nearest, farthest in zip(state.nearest, state.farthest)]


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
        state: carried through the walk, which it may shorten by narrowing its intervals.
        visit: called with the state, a surfel in the hierarchy's order, and the lanes that visit it.
        active: lanes that walk.
    """
    tiny = 1e-12
    inverses, offsets = [], []
    for direction in directions:
        slope = direction * bvh.grid_scale
        inverse = dr.rcp(mi.Vector3f(*[dr.select(dr.abs(v) < tiny, tiny, v) for v in slope]))
        inverses.append(inverse)
        offsets.append(-((origin - bvh.grid_origin) * bvh.grid_scale) * inverse)
    node = mi.UInt32(0)
    going = mi.Bool(active)
    while going:
        leaf, passed, searching = mi.UInt32(0), mi.UInt32(0), mi.Bool(going)
        while searching:
            words = dr.gather(mi.Vector4u, bvh.nodes, node, searching)
            hits = []
            for ray in range(len(directions)):
                entry, leave = state.nearest[ray], state.farthest[ray]
                for axis in range(3):
                    low, high = mi.Float(words[axis] & 0xFFFF), mi.Float(words[axis] >> 16)
                    first = dr.fma(low, inverses[ray][axis], offsets[ray][axis])
                    second = dr.fma(high, inverses[ray][axis], offsets[ray][axis])
                    entry = _larger(entry, _smaller(first, second))
                    leave = _smaller(leave, _larger(first, second))
                hits.append(entry <= leave)
            hit = _any(hits)
            is_leaf = words[3] >= LEAF_BIT
            leaf = dr.select(hit & is_leaf, words[3], 0)
            node = dr.select(hit | is_leaf, node + 1, words[3])
            passed += 1
            searching &= (leaf == 0) & (node < bvh.node_count) & (passed < NODES_BETWEEN_LEAVES)
        surfel = (leaf & (LEAF_BIT - 1)) >> 4
        end = surfel + (leaf & 15)
        while surfel < end:
            state = visit(state, surfel, surfel < end)
            surfel += 1
        going &= (node < bvh.node_count) & _any(_unfinished(state))
    return state
