"""Many fans of shadow rays at once: :mod:`tron.tracing.fan_queue` around the product of transmittance."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

from tron.tracing.bvh import Bvh
from tron.tracing.fan_queue import Line, serve, spread
from tron.tracing.recording import recorded
from tron.tracing.transmittance import BackFaces, Fans, Products, multiply, remaining


def queued_transmittance(bvh: Bvh, fans: Fans, back_faces: BackFaces) -> list[mi.Float]:
    """:func:`tron.tracing.transmittance.transmittance`, evaluated at once; not inside a recorded loop."""
    count = dr.width(fans)
    fans = spread(fans, count)
    found = [dr.zeros(mi.Float, count) for _ in fans.directions]
    dr.make_opaque(fans, found)
    found = _trace(bvh, fans, back_faces, Line.of(count), found)
    return [dr.select(lanes, value, 1) for value, lanes in zip(found, fans.active)]


# Tracing the walk takes Python as long as tracing 10,000 rays takes a core, so it is recorded once for each
# kind of arguments: kernel degree, levels, rays in a fan. Other sizes are free.
@recorded
def _trace(
    bvh: Bvh, fans: Fans, back_faces: BackFaces, line: Line, found: Sequence[mi.Float]
) -> Sequence[mi.Float]:
    """Trace all fans; ``found`` receives what is left of each ray."""

    def begin(fan: mi.UInt32, going: mi.Bool) -> Products:
        return Products.clear([dr.gather(mi.Bool, lanes, fan, going) for lanes in fans.active])

    def visitor(origin: mi.Point3f, along: Sequence[mi.Vector3f]) -> Callable:
        return multiply(bvh, origin, along, back_faces)

    def write(state: Products, fan: mi.UInt32, done: mi.Bool) -> None:
        for value, product in zip(found, state.product):
            dr.scatter(value, remaining(product), fan, done)

    serve(bvh, fans, line, Products.clear([mi.Bool(False) for _ in found]), begin, visitor, write)
    return found
