"""Camera + scene -> GBuffer: one traced, composited and normalised surface point per pixel."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.cameras import Camera
from tron.gaussians.harmonics import sh_basis
from tron.tracing.adjoint import attach, has_gradients
from tron.tracing.compositing import MOST_HITS, STOP_TRANSMITTANCE, Composite, HitList, HitRows, composite
from tron.tracing.hits import MAX_HITS, LocalHits, Walk, collect, drop, settle, sort
from tron.tracing.kernel import SurfelRecords, recorded
from tron.tracing.surface import Surface, surface
from tron.tracing.tiled.kbuffer import (
    LISTED_IDS,
    RelistedHits,
    Search,
    composite_rounds,
    lanes_of,
    search_list,
)
from tron.tracing.tiled.tiles import (
    LANES,
    MOST_ENTRIES,
    TILE,
    TileLists,
    TooManyEntries,
    build_tiles,
    lanes_of_pixels,
    tile_counts,
    tile_pixels,
)

KEPT_HITS = 128
"""Most hits per ray whose ids are stored, 4 bytes each."""
FEW_HITS = 64
"""Hits per ray whose ids are stored if no tile list is longer than this."""


@dataclass
class GBuffer(Surface):
    """View of one camera: a :class:`Surface` whose lanes are its pixels tile by tile.

    Tiles at the right and at the bottom may hang over the image's edge: opacity is 0 there.

    Attributes:
        width, height: pixels.
    """

    width: int
    height: int

    @staticmethod
    def of_rows(surface: Surface, width: int, height: int) -> GBuffer:
        """Make a G-buffer from pixels in row-major order."""
        _, x, y, inside = tile_pixels(width, height)
        pixel = y * dr.opaque(mi.UInt32, width) + x
        tiled = dr.gather(dict, _held(surface), pixel, inside)
        return GBuffer(**{"values": []} | tiled, width=width, height=height)

    @property
    def pixel(self) -> mi.UInt32:
        """Row-major number of each lane's pixel."""
        _, x, y, _ = tile_pixels(self.width, self.height)
        return y * dr.opaque(mi.UInt32, self.width) + x

    def in_rows(self, values: Any) -> Any:
        """Reorder values of lanes (Dr.Jit, or a tree of it) to pixels, row by row; differentiable."""
        lane = lanes_of_pixels(self.width, self.height)
        return dr.gather(type(values), values, lane, mode=dr.ReduceMode.Permute)

    def rows(self) -> Surface:
        """The surface with one lane per pixel, row by row; differentiable."""
        return Surface(**{"values": []} | self.in_rows(_held(self)))

    def image(self, value: Any) -> np.ndarray:
        """Values of the lanes (Dr.Jit) as an image (H, W) or (H, W, C) float32."""
        return self.images({"value": value})["value"]

    def images(self, values: dict[str, Any]) -> dict[str, np.ndarray]:
        """:meth:`image` of many, made at once."""
        values = self.in_rows(dr.detach(values))
        dr.eval(values)
        return {name: self._pixels(value) for name, value in values.items()}

    def numpy(self) -> dict[str, np.ndarray]:
        """Every field as (H, W) or (H, W, 3) float32; C ``values`` as (H, W, C)."""
        return self.images(_held(self))

    def _pixels(self, value: Any) -> np.ndarray:
        if isinstance(value, mi.Float):
            return np.array(value).reshape(self.height, self.width)
        # One by one: copying them together would compile a kernel for each size.
        channels = np.stack([np.array(channel) for channel in value], axis=-1)
        return channels.reshape(self.height, self.width, -1)


def _held(surface: Surface) -> dict[str, Any]:
    """The fields of a surface that are set."""
    names = [f.name for f in fields(Surface) if f.name != "values" or surface.values]
    return {name: getattr(surface, name) for name in names if getattr(surface, name) is not None}


@dataclass
class TileRays:
    """Rays of all pixels in tile order: lane = tile * 16 + pixel within the tile."""

    origin: mi.Point3f
    direction: mi.Vector3f
    tile: mi.UInt32
    inside: mi.Bool


def tile_rays(camera: Camera) -> TileRays:
    """Rays through pixel centres. Camera numbers are opaque: literals would compile a kernel per view."""
    tile, x, y, inside = tile_pixels(camera.width, camera.height)
    fx, fy, cx, cy = (dr.opaque(mi.Float, float(v)) for v in (camera.fx, camera.fy, camera.cx, camera.cy))
    rotation = camera.camera_to_world[:3, :3]
    right, down, forward = (mi.Vector3f([float(v) for v in rotation[:, k]]) for k in range(3))
    origin = mi.Point3f([float(v) for v in camera.position])
    dr.make_opaque(right, down, forward, origin)
    direction = dr.normalize(
        ((mi.Float(x) + 0.5 - cx) / fx) * right + ((mi.Float(y) + 0.5 - cy) / fy) * down + forward
    )
    return TileRays(origin, direction, tile, inside)


def trace_tiles(
    records: SurfelRecords,
    lists: TileLists,
    rays: TileRays,
    keep_hits: bool,
    limit: mi.Float | None = None,
) -> tuple[Composite, list[Iterable[HitList]]]:
    """Composited sums of every ray in tile order and, if wanted, the lists of their hits.

    Rays with more hits than streaming can hold are traced again, some hits at a time, without limit. If
    these hits are too many to store, iterating over the lists finds them again.

    Args:
        records: the surfels, detached.
        lists: tile lists. rays: the rays of their pixels.
        limit: distance of each ray beyond which no surfel counts, world units; None: no limit.
    """
    start = dr.gather(mi.UInt32, lists.start, rays.tile)
    count = dr.select(rays.inside, dr.gather(mi.UInt32, lists.count, rays.tile), 0)
    out = None
    if keep_hits:
        # Only two sizes: the kernel is recorded again for each size of unwritten memory.
        capacity = FEW_HITS if int(dr.max(lists.count)[0]) <= FEW_HITS else KEPT_HITS
        out = HitList.empty(dr.arange(mi.UInt32, dr.width(rays.tile)), capacity)
    sums, crowded, kept_hits = stream(
        # Without the number of surfels, for each of which the kernel would be recorded again.
        replace(records, count=0), lists.entries, lists.near, start, count, rays.origin, rays.direction,
        None if out is None else out.rows(), limit,
    )  # fmt: skip
    known: list[Iterable[HitList]] = []
    if out is not None:
        out.count = kept_hits
        known.append([out])
    again = dr.compress(crowded)
    if dr.width(again) == 0:
        return sums, known
    start, count = (dr.gather(mi.UInt32, values, again) for values in (start, count))
    direction = dr.gather(mi.Vector3f, rays.direction, again)
    end = mi.Float(dr.inf) if limit is None else dr.gather(mi.Float, limit, again)

    def search(lane: mi.UInt32) -> Search:
        first, length = (dr.gather(mi.UInt32, values, lane) for values in (start, count))
        along, far = dr.gather(mi.Vector3f, direction, lane), lanes_of(end, lane)
        return partial(
            search_list, records, lists.entries, lists.near, first, length, rays.origin, along, far
        )

    capacity = min(int(dr.max(count)[0]), MOST_HITS)
    fits = keep_hits and capacity * dr.width(again) <= LISTED_IDS
    more = HitList.empty(again, capacity) if fits else None
    every = dr.arange(mi.UInt32, dr.width(again))
    traced = composite_rounds(records, search(every), direction, mi.Bool(True), more)
    dr.eval(traced, more)
    if more is not None:
        more.count = traced.count
        known.append([more])
    elif keep_hits:
        known.append(RelistedHits(records, search, direction, again, traced.count))
    _overwrite(sums, traced, again)
    return sums, known


def _overwrite(sums: Composite, some: Composite, ray: mi.UInt32) -> None:
    """Overwrite the sums of the rays ``ray``."""
    for target, source in zip(sums.channels + sums.front, some.channels + some.front, strict=True):
        dr.scatter(target, source, ray)
    for name in ("mean_depth", "transmittance", "median", "begin", "first", "other", "count"):
        dr.scatter(getattr(sums, name), getattr(some, name), ray)
    dr.eval(sums)


def trace_gbuffer(
    records: SurfelRecords,
    lists: TileLists,
    camera: Camera,
    limit: mi.Float | None = None,
    disks: SurfelRecords | None = None,
) -> GBuffer:
    """Render a camera's G-buffer from its tile lists, up to ``limit``; differentiable in the records.

    ``disks``: the surfels in space, where the records are their projections; None: the records.
    """
    rays = tile_rays(camera)
    sums, hits = trace_tiles(records.detached(), lists, rays, has_gradients(records, rays.direction), limit)
    sums = attach(sums, records, rays.origin, rays.direction, hits)
    seen = surface(sums, disks or records, rays.origin, rays.direction)
    dr.eval(seen)
    return GBuffer(**vars(seen), width=camera.width, height=camera.height)


# A list is sorted by a lower bound of distance, so a hit nearer than the next candidate's bound is final: no
# later candidate lies before it. Each ray collects until it has ``MAX_HITS`` hits or its list ends, sorts
# them, composites the final ones and keeps the others for the next round. Most rays need one round. It fails
# only if ``MAX_HITS`` hits are held and a later candidate might lie before all of them, which takes surfels
# much larger than the distances between them.


# Tracing this code with its sorting networks takes as long as 16,000 rays, so the kernel is recorded once for
# each kind of arguments: degrees, number of values, whether and how many hits are kept. Array sizes may vary.
@recorded
def stream(
    records: SurfelRecords, entries: mi.UInt32, near: mi.Float, start: mi.UInt32, count: mi.UInt32,
    origin: mi.Point3f, direction: mi.Vector3f, out: HitRows | None, limit: mi.Float | None,
) -> tuple[Composite, mi.Bool, mi.UInt32]:  # fmt: skip
    """Composite the front-facing hits of each ray, in one kernel.

    Args:
        records: the surfels, detached.
        entries, near: tile lists' ids and lower bounds of t; start, count: each ray's slice of them.
        origin, direction: world rays, unit directions.
        out: receives the composited ids, list r from lane r, as many as fit.
        limit: distance of each ray beyond which no surfel counts, world units; None: no limit.

    Returns:
        All evaluated: the sums of each ray; whether the ray failed (unfinished, or more hits than ``out`` can
        hold); and its number of ids in ``out``, 0 if it failed.
    """
    sums, crowded = _rounds(records, entries, near, Walk.along(start, count, limit), origin, direction, out)
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


def trace_view(
    records: SurfelRecords,
    camera: Camera,
    limit: mi.Float | None = None,
    disks: SurfelRecords | None = None,
) -> GBuffer:
    """:func:`trace_gbuffer` by the camera's own lists: in stripes, where these would take gigabytes.

    Raises:
        TooManyEntries: one row of tiles has more than 32-bit indices can address.
    """
    rows = tile_counts(camera.width, camera.height)[1]
    try:
        still = records.detached()
        lists = build_tiles(still, camera, MOST_ENTRIES) if rows > 1 else build_tiles(still, camera)
    except TooManyEntries:
        if rows == 1:
            raise
    else:
        return trace_gbuffer(records, lists, camera, limit, disks)
    upper, width = rows // 2 * TILE, camera.width
    lanes, parts = 0, []
    for y, height in ((0, upper), (upper, camera.height - upper)):
        count = tile_counts(width, height)[0] * tile_counts(width, height)[1] * LANES
        end = None if limit is None else dr.gather(mi.Float, limit, dr.arange(mi.UInt32, count) + lanes)
        parts.append(trace_view(records, camera.window(0, y, width, height), end, disks))
        lanes += count
    return _joined(*parts)


def _joined(upper: GBuffer, lower: GBuffer) -> GBuffer:
    """Join two stripes to one view; the upper one consists of whole tiles; differentiable."""

    def join(above: Any, below: Any) -> Any:
        if above is None:
            return None
        if isinstance(above, list):
            return [join(*each) for each in zip(above, below, strict=True)]
        if isinstance(above, mi.Float):
            return dr.concat([above, below])
        return type(above)(*[join(*each) for each in zip(above, below, strict=True)])

    lanes = {f.name: join(getattr(upper, f.name), getattr(lower, f.name)) for f in fields(Surface)}
    return GBuffer(**lanes, width=upper.width, height=upper.height + lower.height)
