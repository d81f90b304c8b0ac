"""Many fans of rays in line for the lanes that trace them.

Some fans pass twice as many nodes as their neighbours. With a lane for each, the lanes of a packet wait for
the slowest, and only 60 % of them work. Here a lane that is done takes the next fan in line, by a counter
that all lanes share, until none is left (persistent threads: Aila and Laine 2009). What a fan finds is
written at its own place, so the result does not depend on who traced it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from tron.tracing.bvh import Bvh
from tron.tracing.transmittance import Fans
from tron.tracing.traversal import Descent, State, look, search, slopes_of

_NO_FAN = 0xFFFFFFFF


@dataclass
class Line:
    """Fans that wait: their number and how many were taken, one lane each; ``lane`` counts those who take."""

    lane: mi.UInt32
    fans: mi.UInt32
    taken: mi.UInt32

    @staticmethod
    def of(count: int) -> Line:
        """A line of ``count`` fans, none of them taken."""
        line = Line(dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, 0))
        dr.make_opaque(line)
        return line


def spread(values: Any, width: int) -> Any:
    """``width`` numbers of each array in ``values``, which may be a tree: one for all is repeated."""
    if isinstance(values, Fans):
        return Fans(
            mi.Point3f(*[spread(dr.detach(v), width) for v in values.origin]),
            [mi.Vector3f(*[spread(dr.detach(v), width) for v in along]) for along in values.directions],
            [spread(mi.Bool(lanes), width) for lanes in values.active],
        )
    if dr.width(values) == width:
        return values
    return dr.gather(type(values), values, dr.zeros(mi.UInt32, width))


@dr.syntax
def serve(
    bvh: Bvh,
    fans: Fans,
    line: Line,
    state: State,
    begin: Callable[[mi.UInt32, mi.Bool], State],
    visitor: Callable[[mi.Point3f, Sequence[mi.Vector3f]], Callable[[State, mi.UInt32, mi.Bool], State]],
    write: Callable[[State, mi.UInt32, mi.Bool], None],
) -> State:
    """Walk all fans of ``line``.

    Args:
        bvh: the hierarchy. fans: as many rays each as ``state`` has intervals. line: their line.
        state: of a walk that is over.
        begin: the state in which the walk of a fan begins, in the lanes given.
        visitor: of the walk of a fan from its origin along its directions.
        write: takes the state in which the walk of a fan ended, in the lanes given.
    """
    rays = range(len(fans.directions))
    fan, going = mi.UInt32(_NO_FAN), line.lane < line.fans
    origin, along = mi.Point3f(0), [mi.Vector3f(0) for _ in rays]
    slopes = [mi.Vector3f(0) for _ in rays]
    at = Descent.begun()
    while going:
        if ~at.unfinished(state):
            write(state, fan, fan < line.fans)
            fan = dr.scatter_inc(line.taken, mi.UInt32(0))
            going = fan < line.fans
            origin = mi.Point3f(*[dr.gather(mi.Float, v, fan, going) for v in fans.origin])
            for ray in rays:
                along[ray] = mi.Vector3f(*[dr.gather(mi.Float, v, fan, going) for v in fans.directions[ray]])
                slopes[ray] = slopes_of(along[ray])
            at = Descent.begun()
            state = begin(fan, going)
        at = search(bvh, origin, slopes, state, at, going)
        at, state = look(at, state, visitor(origin, along), going)
    return state
