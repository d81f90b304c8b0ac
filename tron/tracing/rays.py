"""Any rays -> what they see, through the hierarchy: for rays that do not come from one pinhole."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from tron.tracing.adjoint import attach, has_gradients
from tron.tracing.bvh import Bvh
from tron.tracing.compositing import HitList
from tron.tracing.kbuffer import composite_rounds, search_hierarchy
from tron.tracing.kernel import SurfelRecords
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
        # The lists that the adjoint replays need room, and how much is known only now.
        dr.eval(sums)
        ray = dr.arange(mi.UInt32, dr.width(sums.count))
        hits = HitList.empty(ray, max(1, int(dr.max(sums.count)[0])))
        hits.count = composite_rounds(still, search, along, active, hits).count
        dr.eval(hits.ids, hits.count)
        sums = attach(sums, records, at, direction, [hits])
    return surface(sums, at, along)
