"""Many fans of shadow rays in line for the lanes that trace them.

Some fans pass twice as many nodes as their neighbours. With a lane for each, the lanes of a packet wait for
the slowest, and only 60 % of them work. Here a lane that is done takes the next fan in line, by a counter
that all lanes share, until none is left (persistent threads: Aila and Laine 2009). What a fan finds is
written at its own place, so the result does not depend on who traced it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from tron.tracing.bvh import Bvh
from tron.tracing.recording import recorded
from tron.tracing.transmittance import BackFaces, Fans, Products, multiply, remaining
from tron.tracing.traversal import Descent, look, search, slopes_of

_NO_FAN = 0xFFFFFFFF


@dataclass
class Line:
    """Fans that wait: their number and how many were taken, one lane each; ``lane`` counts those who take."""

    lane: mi.UInt32
    fans: mi.UInt32
    taken: mi.UInt32


def queued_transmittance(bvh: Bvh, fans: Fans, back_faces: BackFaces) -> list[mi.Float]:
    """:func:`tron.tracing.transmittance.transmittance`, evaluated at once; not inside a recorded loop."""
    count = dr.width(fans)
    fans = Fans(
        mi.Point3f(*[_spread(dr.detach(v), count) for v in fans.origin]),
        [mi.Vector3f(*[_spread(dr.detach(v), count) for v in along]) for along in fans.directions],
        [_spread(mi.Bool(lanes), count) for lanes in fans.active],
    )
    dr.eval(fans)
    found = [dr.zeros(mi.Float, count) for _ in fans.directions]
    line = Line(dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, 0))
    dr.make_opaque(found, line)
    found = _trace(bvh, fans, back_faces, line, found)
    return [dr.select(lanes, value, 1) for value, lanes in zip(found, fans.active)]


def _spread(value: Any, width: int) -> Any:
    """``width`` numbers: one for all is repeated."""
    if dr.width(value) == width:
        return value
    return dr.gather(type(value), value, dr.zeros(mi.UInt32, width))


# Tracing the walk takes Python as long as tracing 10,000 rays takes a core, so it is recorded once for each
# kind of arguments: kernel degree, levels, rays in a fan. Other sizes are free.
@recorded
@dr.syntax
def _trace(
    bvh: Bvh, fans: Fans, back_faces: BackFaces, line: Line, found: Sequence[mi.Float]
) -> Sequence[mi.Float]:
    """Trace all fans; ``found`` receives what is left of each ray."""
    rays = range(len(fans.directions))
    fan, going = mi.UInt32(_NO_FAN), line.lane < line.fans
    origin, along = mi.Point3f(0), [mi.Vector3f(0) for _ in rays]
    slopes = [mi.Vector3f(0) for _ in rays]
    at, state = Descent.begun(), Products.clear([mi.Bool(False) for _ in rays])
    while going:
        if ~at.unfinished(state):
            for value, product in zip(found, state.product):
                dr.scatter(value, remaining(product), fan, fan < line.fans)
            fan = dr.scatter_inc(line.taken, mi.UInt32(0))
            going = fan < line.fans
            origin = mi.Point3f(*[dr.gather(mi.Float, v, fan, going) for v in fans.origin])
            for ray in rays:
                along[ray] = mi.Vector3f(*[dr.gather(mi.Float, v, fan, going) for v in fans.directions[ray]])
                slopes[ray] = slopes_of(along[ray])
            at = Descent.begun()
            state = Products.clear([dr.gather(mi.Bool, lanes, fan, going) for lanes in fans.active])
        at = search(bvh, origin, slopes, state, at, going)
        at, state = look(at, state, multiply(bvh, origin, along, back_faces), going)
    return found
