"""Sorted per-ray hit lists: walk a tile's candidates, keep what the ray meets, sort by distance.

Visibility is settled here and is not differentiated; what follows (compositing) is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from tron.tracing.kernel import T_MIN, SurfelRecords, intersect

MAX_HITS = 64
"""Hits kept a ray; rays that meet more are traced by :mod:`tron.tracing.kbuffer` instead."""


NEAR_SLACK = 0.9999
"""Lists are sorted by a ``near`` that may differ from the one recomputed at a ray by rounding."""


@dataclass
class LocalHits:
    """The hits of each lane in thread-local memory, slot 0 nearest; alive inside one kernel only.

    Attributes:
        t, alpha: local arrays of mi.Float; index: of mi.UInt32. ``MAX_HITS`` slots and one for rejects.
        count: mi.UInt32, hits kept; met: hits met before the cap.
    """

    t: Any
    index: Any
    alpha: Any
    count: mi.UInt32
    met: mi.UInt32


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
    records: SurfelRecords, entries: mi.UInt32, start: mi.UInt32, count: mi.UInt32,
    origin: mi.Point3f, direction: mi.Vector3f, stop: float,
) -> LocalHits:  # fmt: skip
    """Walk each lane's candidate list and keep its front-facing hits, unsorted.

    Exact early end: once the product of (1 - alpha) over what was met falls below ``stop``, nothing beyond
    the farthest hit met so far can matter, because those hits alone already stop the ray.  Lists are sorted
    by ``near``, so traversal ends at the first candidate that begins beyond that distance.

    Args:
        records: the surfels.
        entries: tile lists' ids; start, count: each lane's slice of them.
        origin, direction: world rays, unit directions.
        stop: transmittance at which compositing ends.
    """
    # Slot MAX_HITS takes the writes of rejected candidates: a masked write inside a nested loop crashed LLVM.
    kept_t = dr.alloc_local(mi.Float, MAX_HITS + 1, value=mi.Float(0))
    kept_index = dr.alloc_local(mi.UInt32, MAX_HITS + 1, value=mi.UInt32(0))
    kept_alpha = dr.alloc_local(mi.Float, MAX_HITS + 1, value=mi.Float(0))
    met, cursor, end = mi.UInt32(0), mi.UInt32(start), start + count
    product, farthest, t_cut = mi.Float(1), mi.Float(0), mi.Float(dr.inf)
    active = cursor < end
    while active:
        index = dr.gather(mi.UInt32, entries, cursor)
        hit = intersect(records.geometry, index, origin, direction, records.degree)
        valid = hit.within & hit.front & (hit.t > T_MIN) & (hit.t <= t_cut)
        slot = dr.select(valid & (met < MAX_HITS), met, mi.UInt32(MAX_HITS))
        kept_t[slot] = hit.t
        kept_index[slot] = index
        kept_alpha[slot] = hit.alpha
        met += dr.select(valid, mi.UInt32(1), mi.UInt32(0))
        product = dr.select(valid, product * (1 - hit.alpha), product)
        farthest = dr.select(valid & (hit.t > farthest), hit.t, farthest)
        t_cut = dr.select((product < stop) & (t_cut == dr.inf), farthest, t_cut)
        cursor += 1
        active &= (cursor < end) & (NEAR_SLACK * hit.near <= t_cut)
    kept = dr.select(met < MAX_HITS, met, mi.UInt32(MAX_HITS))
    return LocalHits(kept_t, kept_index, kept_alpha, kept, met)


@dr.syntax
def sort(hits: LocalHits) -> None:
    """Order each lane's hits by (t, id) in place, by a sorting network in registers.

    Most packets use less than half the slots, and half the slots are a third of the network.
    """
    t, index, alpha = hits.t, hits.index, hits.alpha
    if hits.count > MAX_HITS // 2:
        t, index, alpha = _sorted(hits.count, t, index, alpha, MAX_HITS)
    else:
        t, index, alpha = _sorted(hits.count, t, index, alpha, MAX_HITS // 2)
    hits.t, hits.index, hits.alpha = t, index, alpha


def _sorted(count: mi.UInt32, t: Any, index: Any, alpha: Any, size: int) -> tuple[Any, Any, Any]:
    """The first ``size`` slots in order; slots beyond ``count`` hold nothing and end up last."""
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
