"""Exact compositing of any number of hits, the K nearest at a time.

Each round searches for the K nearest hits behind the last one composited; (t, id) orders hits, so coincident
surfels are neither lost nor hit twice. Arbitrary rays search the hierarchy. Camera rays with more hits than
:mod:`tron.tracing.gbuffer` can hold, which are few, search the list of their tile. This is slower, but
nothing overflows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi

from tron.gaussians.harmonics import sh_basis
from tron.tracing.compositing import STOP_TRANSMITTANCE, Composite, HitList, composite
from tron.tracing.hierarchy.bvh import Bvh
from tron.tracing.hierarchy.traversal import walk
from tron.tracing.hits import LocalHits
from tron.tracing.kernel import T_MIN, SurfelHit, SurfelRecords, intersect

K = 16
_NO_ID = 0xFFFFFFFF
Search: TypeAlias = "Callable[[_Nearest, mi.Bool], _Nearest]"
"""Fills the slots, in the lanes given, with the nearest hits behind (nearest, last)."""
LISTED_IDS = 1 << 26
"""Most ids held in memory at a time, 4 bytes each; a single ray may need more."""


@dataclass
class _Nearest:
    """The nearest hits behind (nearest, last), ascending by (t, id); t is infinite in slots without a hit.

    Attributes:
        t, alpha: K of mi.Float; index: K of mi.UInt32, the scene's ids.
        nearest, last: t and id of the last hit composited; nearest is a list of one, as walks expect.
        farthest: t beyond which nothing is kept, a list of one: the last slot's, or the end of the ray.
    """

    t: list[mi.Float]
    index: list[mi.UInt32]
    alpha: list[mi.Float]
    nearest: list[mi.Float]
    last: mi.UInt32
    farthest: list[mi.Float]

    @staticmethod
    def behind(nearest: mi.Float, last: mi.UInt32) -> _Nearest:
        """Initial state: nothing found yet behind the hit (nearest, last)."""
        return _Nearest(
            t=[mi.Float(dr.inf) for _ in range(K)],
            index=[mi.UInt32(_NO_ID) for _ in range(K)],
            alpha=[mi.Float(0) for _ in range(K)],
            nearest=[mi.Float(nearest)],
            last=mi.UInt32(last),
            farthest=[mi.Float(dr.inf)],
        )


@dr.syntax
def _insert(kept: _Nearest, hit: SurfelHit, index: mi.UInt32, active: mi.Bool) -> _Nearest:
    """Keep a hit if it is among the nearest."""
    behind = (hit.t > kept.nearest[0]) | ((hit.t == kept.nearest[0]) & (index > kept.last))
    if active & hit.within & hit.front & behind & (hit.t <= kept.farthest[0]):
        t, alpha = hit.t, hit.alpha
        for slot in range(K):
            nearer = (t < kept.t[slot]) | ((t == kept.t[slot]) & (index < kept.index[slot]))
            t_, index_, alpha_ = kept.t[slot], kept.index[slot], kept.alpha[slot]
            kept.t[slot] = dr.select(nearer, t, t_)
            kept.index[slot] = dr.select(nearer, index, index_)
            kept.alpha[slot] = dr.select(nearer, alpha, alpha_)
            t, index, alpha = (
                dr.select(nearer, t_, t),
                dr.select(nearer, index_, index),
                dr.select(nearer, alpha_, alpha),
            )
        kept.farthest[0] = dr.select(kept.t[K - 1] < kept.farthest[0], kept.t[K - 1], kept.farthest[0])
    return kept


def search_hierarchy(bvh: Bvh, origin: mi.Point3f, direction: mi.Vector3f) -> Search:
    """Make a search for hits of arbitrary rays, unit directions, in the hierarchy."""

    def visit(kept: _Nearest, surfel: mi.UInt32, active: mi.Bool) -> _Nearest:
        hit = intersect(bvh.geometry, surfel, origin, direction, bvh.degree)
        return _insert(kept, hit, dr.gather(mi.UInt32, bvh.order, surfel, active), active)

    return lambda kept, active: walk(bvh, origin, [direction], kept, visit, active)


@dr.syntax
def search_list(
    records: SurfelRecords, entries: mi.UInt32, near: mi.Float, start: mi.UInt32, count: mi.UInt32,
    origin: mi.Point3f, direction: mi.Vector3f, limit: mi.Float, kept: _Nearest, active: mi.Bool,
) -> _Nearest:  # fmt: skip
    """Make a search for hits of camera rays in their tiles' lists, up to the distance ``limit`` of each ray.

    Other arguments as in ``hits.collect``.
    """
    kept.farthest[0] = mi.Float(limit)
    cursor, end = mi.UInt32(start), start + count
    going = active & (cursor < end)
    while going:
        index = dr.gather(mi.UInt32, entries, cursor, going)
        hit = intersect(records.geometry, index, origin, direction, records.degree, records.pixel)
        kept = _insert(kept, hit, index, going)
        cursor += 1
        going &= cursor < end
        going &= dr.gather(mi.Float, near, cursor, going) <= kept.farthest[0]
    return kept


@dr.syntax
def composite_rounds(
    records: SurfelRecords,
    search: Search,
    direction: mi.Vector3f,
    active: mi.Bool,
    out: HitList | None = None,
) -> Composite:
    """Composite the front-facing hits of each ray, however many.

    Args:
        records: the surfels, in the scene's order.
        search: finds the nearest hits.
        direction: of the rays, unit, world; SH is evaluated there.
        active: lanes to trace; the others meet nothing.
        out: receives the composited ids of lane r in list r, which must have room.
    """
    basis = sh_basis(direction.x, direction.y, direction.z)
    local_t = dr.alloc_local(mi.Float, K, value=mi.Float(0))
    local_index = dr.alloc_local(mi.UInt32, K, value=mi.UInt32(0))
    local_alpha = dr.alloc_local(mi.Float, K, value=mi.Float(0))
    sums = Composite.start(records.value_count)
    rows = None
    if dr.hint(out is not None, mode="scalar"):
        rows = out.rows()
    nearest, last = mi.Float(T_MIN), mi.UInt32(_NO_ID)  # the largest id: a hit at T_MIN itself does not count
    going = mi.Bool(active)
    while going:
        kept = search(_Nearest.behind(nearest, last), going)
        count = mi.UInt32(0)
        for slot in range(K):
            local_t[slot] = kept.t[slot]
            local_index[slot] = kept.index[slot]
            local_alpha[slot] = kept.alpha[slot]
            count += dr.select(kept.t[slot] < dr.inf, mi.UInt32(1), mi.UInt32(0))
        hits = LocalHits(local_t, local_index, local_alpha, count)
        sums = composite(records, hits, basis, sums, rows)
        nearest, last = kept.t[K - 1], kept.index[K - 1]
        going &= (count == K) & (sums.transmittance >= STOP_TRANSMITTANCE)
    return sums


class RelistedHits:
    """Lists of the hits of some rays; each iteration finds them again and yields them batch after batch.

    The adjoint replays each ray's hits. If many rays meet many surfels, keeping their ids from the forward to
    the backward pass would take too much memory; the backward pass composites such rays again, in batches.
    Not a dataclass, because Dr.Jit would traverse and rebuild it.

    Args:
        records: the surfels, detached.
        search: lanes of ``ray`` (mi.UInt32) -> the search for these rays' hits.
        direction: of the rays in ``ray``, unit, world.
        ray: mi.UInt32, the ray that each lane belongs to.
        count: mi.UInt32, composited hits of each lane, evaluated.
    """

    def __init__(
        self,
        records: SurfelRecords,
        search: Callable[[mi.UInt32], Search],
        direction: mi.Vector3f,
        ray: mi.UInt32,
        count: mi.UInt32,
    ) -> None:
        self._records, self._search, self._direction = records, search, direction
        self._ray, self._count = ray, count

    def __iter__(self) -> Iterator[HitList]:
        rays, capacity = dr.width(self._ray), max(1, int(dr.max(self._count)[0]))
        batch = max(1, LISTED_IDS // capacity)
        for first in range(0, rays, batch):
            lane = dr.arange(mi.UInt32, min(batch, rays - first)) + dr.opaque(mi.UInt32, first)
            hits = HitList.empty(dr.gather(mi.UInt32, self._ray, lane), capacity)
            active = dr.gather(mi.UInt32, self._count, lane) > 0
            direction = lanes_of(self._direction, lane)
            hits.count = composite_rounds(self._records, self._search(lane), direction, active, hits).count
            dr.eval(hits.ids, hits.count)
            yield hits


def lanes_of(values: Any, lane: mi.UInt32) -> Any:
    """Gather some lanes of ``values``, which may be one number for all."""
    return values if dr.width(values) == 1 else dr.gather(type(values), values, lane)
