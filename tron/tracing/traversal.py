"""The walk through the hierarchy, for whoever wants to visit the surfels near a ray, in any order."""

# pyright: reportOperatorIssue=false, reportArgumentType=false
# (Mitsuba's type stubs know neither arithmetic between its own array types nor its aliases of Dr.Jit's.)

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import drjit as dr
import mitsuba as mi

from tron.tracing.bvh import LEAF_BIT, Bvh


class Interval(Protocol):
    """What a walk carries along: at least the distances between which surfels can still matter.

    Attributes:
        nearest, farthest: world units along the unit ray; a walk ends early once nearest > farthest.
    """

    nearest: mi.Float
    farthest: mi.Float


State = TypeVar("State", bound=Interval)


def _smaller(a: mi.Float, b: mi.Float) -> mi.Float:
    return dr.select(a < b, a, b)


def _larger(a: mi.Float, b: mi.Float) -> mi.Float:
    return dr.select(a > b, a, b)


@dr.syntax
def walk(
    bvh: Bvh,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    state: State,
    visit: Callable[[State, mi.UInt32, mi.Bool], State],
    active: mi.Bool,
) -> State:
    """Visit every surfel whose box meets the ray within ``[state.nearest, state.farthest]``.

    Args:
        bvh: the hierarchy.
        origin: world. direction: unit, world.
        state: carried through the walk, which it may shorten by narrowing its interval.
        visit: called with the state, a surfel in the hierarchy's order, and the lanes that visit it.
        active: lanes that walk.
    """
    grid_direction = direction * bvh.grid_scale
    tiny = 1e-12
    inverse = dr.rcp(mi.Vector3f(*[dr.select(dr.abs(v) < tiny, tiny, v) for v in grid_direction]))
    offset = -((origin - bvh.grid_origin) * bvh.grid_scale) * inverse
    node = mi.UInt32(0)
    going = mi.Bool(active)
    while going:
        words = dr.gather(mi.Vector4u, bvh.nodes, node, going)
        entry, leave = state.nearest, state.farthest
        for axis in range(3):
            first = dr.fma(mi.Float(words[axis] & 0xFFFF), inverse[axis], offset[axis])
            second = dr.fma(mi.Float(words[axis] >> 16), inverse[axis], offset[axis])
            entry = _larger(entry, _smaller(first, second))
            leave = _smaller(leave, _larger(first, second))
        hit = entry <= leave
        leaf = words[3] >= LEAF_BIT
        surfels = dr.select(hit & leaf & going, words[3] & 15, 0)
        surfel = (words[3] & (LEAF_BIT - 1)) >> 4
        end = surfel + surfels
        while surfel < end:
            state = visit(state, surfel, surfel < end)
            surfel += 1
        node = dr.select(hit | leaf, node + 1, words[3])
        going &= (node < bvh.node_count) & (state.nearest <= state.farthest)
    return state
