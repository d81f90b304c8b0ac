"""Many fans of shadow rays in line for the lanes that trace them.

Some fans pass twice as many nodes as their neighbours. With a lane for each, the lanes of a packet wait for
the slowest, and only 60 % of them work. Here a lane that is done takes the next fan in line, by a counter that
all lanes share, until none is left (persistent threads: Aila and Laine 2009). What a fan finds is written at
its own place, so the result does not depend on who traced it.
"""

# pyright: reportOperatorIssue=false, reportArgumentType=false
# (Mitsuba's type stubs know neither arithmetic between its own array types nor its aliases of Dr.Jit's.)

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from tron.tracing.bvh import Bvh
from tron.tracing.transmittance import Products, multiply, remaining
from tron.tracing.traversal import Walk, look, search, slopes_of

_NO_FAN = 0xFFFFFFFF


def queued_transmittance(
    bvh: Bvh,
    origin: mi.Point3f,
    directions: Sequence[mi.Vector3f],
    back_faces_from: mi.Float,
    active: Sequence[mi.Bool],
) -> list[mi.Float]:
    """:func:`tron.tracing.transmittance.transmittance`, evaluated at once; not inside a recorded loop."""
    fans = dr.width(origin, directions, active)
    origin = mi.Point3f(*[_spread(dr.detach(v), fans) for v in origin])
    directions = [mi.Vector3f(*[_spread(dr.detach(v), fans) for v in along]) for along in directions]
    active = [_spread(mi.Bool(lanes), fans) for lanes in active]
    dr.eval(origin, directions, active)
    found = [dr.empty(mi.Float, fans) for _ in directions]
    _trace(bvh, origin, directions, back_faces_from, active, dr.zeros(mi.UInt32), found)
    dr.eval(found)
    return [dr.select(lanes, value, 1) for value, lanes in zip(found, active)]


def _spread(value: Any, width: int) -> Any:
    """``width`` numbers: one for all is repeated."""
    if dr.width(value) == width:
        return value
    return dr.gather(type(value), value, dr.zeros(mi.UInt32, width))


@dr.syntax
def _trace(
    bvh: Bvh,
    origins: mi.Point3f,
    directions: Sequence[mi.Vector3f],
    back_faces_from: mi.Float,
    active: Sequence[mi.Bool],
    taken: mi.UInt32,
    found: Sequence[mi.Float],
) -> None:
    """Trace all fans; ``taken`` counts those that were taken from the line, ``found`` receives what is left."""
    fans = dr.opaque(mi.UInt32, dr.width(origins))
    fan, going = mi.UInt32(_NO_FAN), dr.arange(mi.UInt32, dr.width(origins)) < fans
    origin, along = mi.Point3f(0), [mi.Vector3f(0) for _ in directions]
    slopes = [mi.Vector3f(0) for _ in directions]
    at, state = Walk.begun(), Products.clear([mi.Bool(False) for _ in directions])
    while going:
        if ~at.unfinished(state):
            for value, product in zip(found, state.product):
                dr.scatter(value, remaining(product), fan, fan < fans)
            fan = dr.scatter_inc(taken, mi.UInt32(0))
            going = fan < fans
            origin = mi.Point3f(*[dr.gather(mi.Float, v, fan, going) for v in origins])
            for ray in range(len(directions)):
                along[ray] = mi.Vector3f(*[dr.gather(mi.Float, v, fan, going) for v in directions[ray]])
                slopes[ray] = slopes_of(along[ray])
            at = Walk.begun()
            state = Products.clear([dr.gather(mi.Bool, lanes, fan, going) for lanes in active])
        at = search(bvh, origin, slopes, state, at, going)
        at, state = look(at, state, multiply(bvh, origin, along, back_faces_from), going)
