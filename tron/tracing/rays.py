"""Any rays -> what they see, through the hierarchy: for rays that do not come from one pinhole."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from tron.tracing.adjoint import attach, has_gradients
from tron.tracing.bvh import Bvh
from tron.tracing.kbuffer import Search, composite_rounds, search_hierarchy
from tron.tracing.kernel import SurfelRecords
from tron.tracing.relisting import RelistedHits, lanes_of
from tron.tracing.surface import Surface, surface


def trace_rays(
    records: SurfelRecords, bvh: Bvh, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
) -> Surface:
    """Trace, composite and normalise; differentiable in the records and, through SH alone, in ``direction``.

    Args:
        records: the surfels. bvh: their hierarchy.
        origin: world. direction: unit, world.
        active: lanes to trace; the others see nothing.
    """
    still = records.detached()
    at, along = dr.detach(origin), dr.detach(direction)
    search = search_hierarchy(bvh, at, along)
    sums = composite_rounds(still, search, along, active)
    if has_gradients(records, direction):
        dr.eval(sums)
        ray = dr.arange(mi.UInt32, dr.width(sums.count))

        def search_lanes(lane: mi.UInt32) -> Search:
            return search_hierarchy(bvh, lanes_of(at, lane), lanes_of(along, lane))

        hits = RelistedHits(still, search_lanes, along, ray, sums.count)
        sums = attach(sums, records, at, direction, [hits])
    return surface(sums, at, along)
