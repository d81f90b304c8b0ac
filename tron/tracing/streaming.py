"""Camera rays along their tiles' lists: hits are collected, sorted and composited, as many at a time as fit.

A list is sorted by a lower bound of distance, so what a ray has hit nearer than the next candidate's bound
is final: nothing to come lies before it. Each ray collects until it has ``MAX_HITS`` hits or its list ends,
sorts them, composites the final ones and keeps the others for the next round. Most rays need one round. It
fails only where as many hits as fit wait for candidates that might lie before all of them: surfels much
larger than the distances between them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from tron.gaussians.harmonics import sh_basis
from tron.tracing.compositing import STOP_TRANSMITTANCE, Composite, HitRows, composite
from tron.tracing.hits import MAX_HITS, LocalHits, Walk, collect, drop, settle, sort
from tron.tracing.kernel import SurfelRecords
from tron.tracing.recording import recorded


# Tracing the sorting networks takes as long as 16,000 rays, so the kernel is recorded once for each kind of
# arguments: degrees, number of values, whether hits are kept, and if so for how many. Other sizes are free.
@recorded
def stream(
    records: SurfelRecords, entries: mi.UInt32, near: mi.Float, start: mi.UInt32, count: mi.UInt32,
    origin: mi.Point3f, direction: mi.Vector3f, out: HitRows | None,
) -> tuple[Composite, mi.Bool, mi.UInt32]:  # fmt: skip
    """Composite the front-facing hits of each ray, in one kernel.

    Args:
        records: the surfels, detached.
        entries, near: tile lists' ids and lower bounds of t; start, count: each ray's slice of them.
        origin, direction: world rays, unit directions.
        out: receives the composited ids, list r from lane r, as many as it has room for.

    Returns:
        All evaluated: the sums of each ray; whether it was not finished, or has more hits than there is room
        for; and how many ids it has in ``out``, none where that is so.
    """
    sums, crowded = _rounds(records, entries, near, Walk.along(start, count), origin, direction, out)
    if out is not None:
        crowded |= sums.count > out.capacity
    return sums, crowded, dr.select(crowded, 0, sums.count)


@dr.syntax
def _rounds(
    records: SurfelRecords, entries: mi.UInt32, near: mi.Float, walk: Walk,
    origin: mi.Point3f, direction: mi.Vector3f, out: HitRows | None,
) -> tuple[Composite, mi.Bool]:  # fmt: skip
    basis = sh_basis(direction.x, direction.y, direction.z)
    hits, sums, full = LocalHits.none(), Composite.start(records.value_count), mi.Bool(False)
    going = mi.Bool(walk.open)
    while going:
        walk, hits = collect(records, entries, near, origin, direction, STOP_TRANSMITTANCE, walk, hits)
        hits = sort(hits)
        walk, hits, final = settle(walk, hits, sums.transmittance, STOP_TRANSMITTANCE)
        ready = LocalHits(hits.t, hits.index, hits.alpha, final)
        sums = composite(records, ready, basis, sums, out)
        hits = drop(hits, final, walk.open)
        full = walk.open & (hits.count == MAX_HITS)
        going &= walk.open & ~full
    return sums, full
