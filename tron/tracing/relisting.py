"""Hit lists that are too long to be kept: found again when they are replayed, a batch of rays at a time.

The adjoint replays each ray's hits. Where many rays meet many surfels, their ids would need too much memory
between the forward and the backward pass; the backward pass composites such rays once more, in batches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

from tron.tracing.compositing import HitList
from tron.tracing.kbuffer import Search, composite_rounds
from tron.tracing.kernel import SurfelRecords

LISTED_IDS = 1 << 26
"""Most ids for which there is memory at once, 4 bytes each; a single ray may need more."""


class RelistedHits:
    """Lists of the hits of some rays; each iteration finds them again and yields them batch after batch.

    No dataclass, which Dr.Jit would take apart and put together again.

    Args:
        records: the surfels, detached.
        search: lanes of ``ray`` (mi.UInt32) -> where to look for the hits of these.
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
    """Some lanes of ``values``, which may be one for all."""
    return values if dr.width(values) == 1 else dr.gather(type(values), values, lane)
