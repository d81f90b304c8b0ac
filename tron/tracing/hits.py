"""Sorted per-ray hit lists: walk a tile's candidates, keep the hits, sort them by distance.

Visibility is decided here and is not differentiated; the compositing that follows is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from tron.tracing.kernel import T_MIN, SurfelRecords, intersect

MAX_HITS = 64
"""Most hits that a ray holds at a time before they are composited."""


@dataclass
class LocalHits:
    """Hits of each lane in thread-local memory; they exist inside one kernel only.

    Attributes:
        t, alpha: local arrays of mi.Float; index: of mi.UInt32. ``MAX_HITS`` slots and one for rejects.
        count: mi.UInt32, number of hits, from slot 0 on.
    """

    t: Any
    index: Any
    alpha: Any
    count: mi.UInt32

    @staticmethod
    def none() -> LocalHits:
        """An empty list with room for ``MAX_HITS`` hits."""
        # The last slot takes the writes of rejected candidates: a masked write in a nested loop crashed LLVM.
        return LocalHits(
            dr.alloc_local(mi.Float, MAX_HITS + 1, value=mi.Float(0)),
            dr.alloc_local(mi.UInt32, MAX_HITS + 1, value=mi.UInt32(0)),
            dr.alloc_local(mi.Float, MAX_HITS + 1, value=mi.Float(0)),
            mi.UInt32(0),
        )


@dataclass
class Walk:
    """Progress of each lane through its list of candidates, and how far it needs to go.

    Attributes:
        cursor, end: mi.UInt32, the next candidate and the end of the list.
        near: mi.Float, lower bound of t of all candidates to come.
        product: mi.Float, transmittance of all hits so far. farthest: largest t of these hits.
        t_cut: mi.Float, distance beyond which nothing can matter.
        open: mi.Bool, the ray may meet more candidates.
    """

    cursor: mi.UInt32
    end: mi.UInt32
    near: mi.Float
    product: mi.Float
    farthest: mi.Float
    t_cut: mi.Float
    open: mi.Bool

    @staticmethod
    def along(start: mi.UInt32, count: mi.UInt32, limit: mi.Float | None = None) -> Walk:
        """Begin at the lists of ``count`` candidates from ``start`` on.

        ``limit``: distance of each ray beyond which no surfel counts, world units; None: no limit.
        """
        return Walk(
            mi.UInt32(start),
            start + count,
            mi.Float(0),
            mi.Float(1),
            mi.Float(0),
            mi.Float(dr.inf if limit is None else limit),
            count > 0,
        )


@cache
def odd_even_merge_network(size: int) -> tuple[tuple[int, int], ...]:
    """Comparators of Batcher's odd-even mergesort for ``size`` = 2^k keys (Batcher 1968)."""
    comparators = []
    span = 1
    while span < size:
        step = span
        while step >= 1:
            for start in range(step % span, size - step, 2 * step):
                for i in range(min(step, size - start - step)):
                    if (start + i) // (span * 2) == (start + i + step) // (span * 2):
                        comparators.append((start + i, start + i + step))
            step //= 2
        span *= 2
    return tuple(comparators)


@dr.syntax
def collect(
    records: SurfelRecords, entries: mi.UInt32, near: mi.Float, origin: mi.Point3f, direction: mi.Vector3f,
    stop: float, walk: Walk, hits: LocalHits,
) -> tuple[Walk, LocalHits]:  # fmt: skip
    """Continue through each lane's candidates and add its front-facing hits, until its slots are full.

    Exact early end: once the product of (1 - alpha) over the hits falls below ``stop``, nothing beyond the
    farthest hit so far can matter, because those hits alone already stop the ray. Lists are sorted
    by ``near``, so traversal ends at the first candidate that begins beyond that distance.

    Args:
        records: the surfels.
        entries, near: tile lists' ids, and their lower bounds of t.
        origin, direction: world rays, unit directions.
        stop: transmittance at which compositing ends.
        walk: each lane's progress. hits: the hits it holds.
    """
    active = walk.open & (hits.count < MAX_HITS)
    while active:
        index = dr.gather(mi.UInt32, entries, walk.cursor)
        hit = intersect(records.geometry, index, origin, direction, records.degree, records.pixel)
        valid = hit.within & hit.front & (hit.t > T_MIN) & (hit.t <= walk.t_cut)
        slot = dr.select(valid, hits.count, mi.UInt32(MAX_HITS))
        hits.t[slot] = hit.t
        hits.index[slot] = index
        hits.alpha[slot] = hit.alpha
        hits.count += dr.select(valid, mi.UInt32(1), mi.UInt32(0))
        walk.product = dr.select(valid, walk.product * (1 - hit.alpha), walk.product)
        walk.farthest = dr.select(valid & (hit.t > walk.farthest), hit.t, walk.farthest)
        stopped = (walk.product < stop) & (walk.farthest < walk.t_cut)
        walk.t_cut = dr.select(stopped, walk.farthest, walk.t_cut)
        walk.cursor += 1
        walk.near = dr.gather(mi.Float, near, walk.cursor, walk.cursor < walk.end)
        walk.open &= (walk.cursor < walk.end) & (walk.near <= walk.t_cut)
        active &= walk.open & (hits.count < MAX_HITS)
    return walk, hits


@dr.syntax
def settle(
    walk: Walk, hits: LocalHits, transmittance: mi.Float, stop: float
) -> tuple[Walk, LocalHits, mi.UInt32]:
    """Number of the sorted ``hits`` that are final: no later candidate can lie before them.

    Hits behind the one that stops the ray are dropped. If the ray is known to stop, the walk may end and all
    remaining hits are final.

    Args:
        transmittance: in front of the first hit.
    """
    slot, final = mi.UInt32(0), mi.UInt32(0)
    t, product = mi.Float(0), mi.Float(transmittance)
    active = walk.open & (hits.count > 0)
    while active:
        t = hits.t[slot]
        final += dr.select(t < walk.near, mi.UInt32(1), mi.UInt32(0))
        product *= 1 - hits.alpha[slot]
        slot += 1
        active &= (slot < hits.count) & (product >= stop)
    hits.count = dr.select(walk.open, slot, hits.count)
    walk.product = product
    walk.farthest = t
    walk.t_cut = dr.select(walk.open & (product < stop), t, walk.t_cut)
    walk.open &= walk.near <= walk.t_cut
    return walk, hits, dr.select(walk.open, final, hits.count)


@dr.syntax
def drop(hits: LocalHits, first: mi.UInt32, active: mi.Bool) -> LocalHits:
    """Remove the ``first`` hits and move the others up."""
    slot = mi.UInt32(first)
    moving = active & (slot < hits.count) & (first > 0)
    while moving:
        hits.t[slot - first] = hits.t[slot]
        hits.index[slot - first] = hits.index[slot]
        hits.alpha[slot - first] = hits.alpha[slot]
        slot += 1
        moving &= slot < hits.count
    hits.count = dr.select(active, hits.count - first, 0)
    return hits


@dr.syntax
def sort(hits: LocalHits) -> LocalHits:
    """Order each lane's hits by (t, id) in place, by a sorting network in registers.

    Most packets use less than half the slots, whose network has a third of the comparators.
    """
    t, index, alpha = hits.t, hits.index, hits.alpha
    if hits.count > MAX_HITS // 2:
        t, index, alpha = _sorted(hits.count, t, index, alpha, MAX_HITS)
    else:
        t, index, alpha = _sorted(hits.count, t, index, alpha, MAX_HITS // 2)
    return LocalHits(t, index, alpha, hits.count)


def _sorted(count: mi.UInt32, t: Any, index: Any, alpha: Any, size: int) -> tuple[Any, Any, Any]:
    """Sort the first ``size`` slots; empty slots, beyond ``count``, come last."""
    ts, ids, alphas = [], [], []
    for slot in range(size):
        ts.append(dr.select(count > slot, t[mi.UInt32(slot)], dr.inf))
        ids.append(index[mi.UInt32(slot)])
        alphas.append(alpha[mi.UInt32(slot)])
    for low, high in odd_even_merge_network(size):
        swap = (ts[high] < ts[low]) | ((ts[high] == ts[low]) & (ids[high] < ids[low]))
        for keys in (ts, ids, alphas):
            first, second = keys[low], keys[high]
            keys[low], keys[high] = dr.select(swap, second, first), dr.select(swap, first, second)
    for slot in range(size):
        t[mi.UInt32(slot)] = ts[slot]
        index[mi.UInt32(slot)] = ids[slot]
        alpha[mi.UInt32(slot)] = alphas[slot]
    return t, index, alpha
