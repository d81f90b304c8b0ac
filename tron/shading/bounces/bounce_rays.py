"""Cosine-distributed rays of every surfel and the hit of each: the part of bounces independent of light.

A ray's direction and random numbers depend only on the seed and its surfel, not on anything that moves, so
rays can be traced again one by one. When some surfels have moved, few rays change: those of moved surfels,
those that had met one, and those that a moved surfel now blocks. The last are found by tracing all rays in a
hierarchy of the moved surfels alone, where a hit counts if it is nearer than the earlier one. The result is
the same, to the byte, as tracing all rays anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from copy import copy
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from tron.seeds import integer
from tron.shading.direct.irradiance import ORIGIN_OFFSET
from tron.shading.direct.sampling import BLOCK_BITS, PixelPoints, morton
from tron.tracing.gbuffer import GBuffer
from tron.tracing.hierarchy.bvh import Bvh, build_bvh
from tron.tracing.hierarchy.first_hit import NOTHING, FirstHit, first_hits, ray_seeds
from tron.tracing.hierarchy.transmittance import BACK_FACE_SPACINGS, Fans
from tron.tracing.kernel import GEOMETRY_PACKETS, RADIUS, SurfelRecords, intersect
from tron.tracing.surface import centres
from tron.tracing.tiled.tiles import tile_pixels
from tron.tracing.tracer import SurfelTracer

AT_ONCE = 1 << 20
"""Surfels whose rays are traced at a time, and single rays."""
OWN = 1 << 31
"""Flag of a hit on the sheet that the ray left."""
OWN_SPACINGS, OWN_COSINE = 1.25, 0.5
"""Largest distance of a ray's origin from the plane of such a hit, in spacings of its surfel, and least
absolute cosine between normals. 1 and 0.7 let 1.0 % of a lamp through a closed sheet, 1 and 0.5 let 0.6 %."""
MANY = 0.2
"""Share of moved surfels above which it is faster to trace all rays anew."""
_WIDTH = 1 << BLOCK_BITS


@dataclass
class Part:
    """Surfels processed together, as an image of their centres.

    Attributes:
        gbuffer: the image, 64 pixels across; opacity 0 where there is no surfel.
        surfel: mi.UInt32, of each lane.
        first: number of pixels in earlier parts.
    """

    gbuffer: GBuffer
    surfel: mi.UInt32
    first: int


def parts(tracer: SurfelTracer, some: mi.UInt32 | None = None) -> Iterator[Part]:
    """All surfels, or ``some``, in the hierarchy's order along the Z curve of square blocks.

    Neighbouring pixels are then neighbours in space: they share the strata of one sequence, their rays pass
    the same nodes, and they can be filtered together.
    """
    order = tracer.bvh.order if some is None else some
    count = dr.width(order) if len(tracer.scene) else 0
    for first in range(0, count, AT_ONCE):
        height = _WIDTH * -(-min(AT_ONCE, count - first) // _WIDTH**2)
        _, x, y, _ = tile_pixels(_WIDTH, height)
        block = (y >> BLOCK_BITS) << (2 * BLOCK_BITS)
        place = dr.opaque(mi.UInt32, first) + (block | morton(x, y & (_WIDTH - 1)))
        inside = place < dr.opaque(mi.UInt32, count)
        surfel = dr.gather(mi.UInt32, order, place, inside)
        surface = centres(tracer.records, surfel, inside)
        dr.eval(surface, surfel)
        yield Part(GBuffer(**vars(surface), width=_WIDTH, height=height), surfel, first)


@dataclass
class _Lanes:
    """Beginnings of the rays of some lanes, one surfel a lane."""

    surfel: mi.UInt32
    active: mi.Bool
    origin: mi.Point3f
    frame: mi.Frame3f
    run: mi.UInt32

    @property
    def normal(self) -> mi.Vector3f:
        """Unit, world, of the surfels."""
        return mi.Vector3f(self.frame.n)


class SurfelRays:
    """``rays`` rays of each of the M surfels of ``tracer``, below ``seed``.

    Their origins and hits follow surfels that move: :meth:`after`.

    Attributes:
        met: mi.UInt32 (rays x M), ray r of surfel i at r M + i: twice the surfel met, plus 1 at its back,
            plus ``OWN`` if it is the ray's own sheet; or ``NOTHING``. See :func:`surfel_met`.
    """

    def __init__(
        self,
        tracer: SurfelTracer,
        rays: int,
        seed: int,
        track: Callable[[range], Iterable[int]] = iter,
    ) -> None:
        self.tracer, self.rays = tracer, rays
        self._count = dr.opaque(mi.UInt32, len(tracer.scene))
        self._points = PixelPoints.make(rays, 1, _WIDTH, seed, "bounce")
        self._root = dr.opaque(mi.UInt32, integer(seed, "bounce", "stops"))
        # A surfel keeps its strata when it moves.
        self._pixel = dr.zeros(mi.UInt32, len(tracer.scene))
        for part in parts(tracer):
            pixel = part.gbuffer.pixel + part.first
            dr.scatter(self._pixel, pixel, part.surfel, part.gbuffer.opacity > 0)
        dr.eval(self._pixel)
        self.met = self._trace(track)

    def after(self, tracer: SurfelTracer) -> SurfelRays:
        """The same rays for the same surfels at their places in ``tracer``."""
        other = copy(self)
        other.tracer = tracer
        changed = _changed(self.tracer.records, tracer.records)
        moved = dr.compress(changed)
        if dr.width(moved) > MANY * dr.width(changed):
            other.met = other._trace(iter)
        elif dr.width(moved) > 0:
            other.met = dr.gather(mi.UInt32, self.met, dr.arange(mi.UInt32, dr.width(self.met)))
            dr.eval(other.met)  # a copy: it is written to
            other._meet(_hierarchy_of(tracer.records, moved), changed)
            other._trace_again(self.met, changed)
        return other

    def of_some(self, tracer: SurfelTracer, surfel: mi.UInt32) -> mi.UInt32:
        """Hits, coded as in ``met``, of the rays of some surfels (B,) in ``tracer``: (rays x B)."""
        other, some = copy(self), dr.opaque(mi.UInt32, dr.width(surfel))
        other.tracer = tracer
        met = dr.empty(mi.UInt32, self.rays * dr.width(surfel))
        for first in range(0, dr.width(surfel), AT_ONCE):
            count = min(AT_ONCE, dr.width(surfel) - first)
            lane = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
            there = dr.full(mi.Bool, True, count)
            dr.eval(lane, there)  # else their order in the kernels depends on earlier computations
            for ray, directions, seeds, lanes in other._fans(dr.gather(mi.UInt32, surfel, lane), there):
                hits = tracer.first_hits(
                    lanes.origin, directions, [there] * len(directions), seeds, lanes.normal
                )
                for k, hit in enumerate(hits):
                    dr.scatter(met, _code(tracer, hit, lanes), (ray + k) * some + lane)
                dr.eval(met)
        return met

    def _lanes(self, surfel: mi.UInt32, active: mi.Bool) -> _Lanes:
        at = centres(self.tracer.records, surfel, active)
        offset = dr.opaque(mi.Float, ORIGIN_OFFSET * self.tracer.scene.spacing)
        run = self._points.run(dr.gather(mi.UInt32, self._pixel, surfel, active))
        lanes = _Lanes(surfel, active, at.position + at.normal * offset, mi.Frame3f(at.normal), run)
        dr.eval(lanes)
        return lanes

    def _ray(self, lanes: _Lanes, ray: mi.UInt32) -> tuple[mi.Vector3f, mi.UInt32]:
        """Unit world direction and seed."""
        u = self._points.point(lanes.run, ray, mi.UInt32(0))
        direction = lanes.frame.to_world(mi.warp.square_to_cosine_hemisphere(u))
        return direction, ray_seeds(self._root, lanes.surfel, ray)

    def _fans(
        self, surfel: mi.UInt32, active: mi.Bool, track: Callable[[range], Iterable[int]] = iter
    ) -> Iterator[tuple[mi.UInt32, list[mi.Vector3f], list[mi.UInt32], _Lanes]]:
        """All rays of the surfels, one fan at a time: its first ray, directions, seeds and origins."""
        lanes = self._lanes(surfel, active)
        for first in track(range(0, self.rays, self._points.fan)):
            ray = dr.opaque(mi.UInt32, first)
            rays = [self._ray(lanes, ray + k) for k in range(self._points.fan)]
            directions, seeds = [direction for direction, _ in rays], [seed for _, seed in rays]
            dr.eval(directions, seeds)
            yield ray, directions, seeds, lanes

    def _trace(self, track: Callable[[range], Iterable[int]]) -> mi.UInt32:
        """Trace all rays: ``met``."""
        met = dr.empty(mi.UInt32, self.rays * len(self.tracer.scene))
        for part in parts(self.tracer):
            for ray, directions, seeds, lanes in self._fans(part.surfel, part.gbuffer.opacity > 0, track):
                active = [lanes.active] * len(directions)
                hits = self.tracer.first_hits(lanes.origin, directions, active, seeds, lanes.normal)
                for k, hit in enumerate(hits):
                    code = _code(self.tracer, hit, lanes)
                    dr.scatter(met, code, (ray + k) * self._count + lanes.surfel, lanes.active)
                dr.eval(met)
        return met

    def _meet(self, few: Bvh, changed: mi.Bool) -> None:
        """Replace hits of unmoved surfels' rays by nearer hits on moved surfels."""
        records, back_faces = self.tracer.records, self.tracer.back_faces
        for part in parts(self.tracer):
            still = (part.gbuffer.opacity > 0) & ~dr.gather(mi.Bool, changed, part.surfel)
            for ray, directions, seeds, lanes in self._fans(part.surfel, still):
                fans = Fans(lanes.origin, directions, [still] * len(directions), lanes.normal)
                for k, hit in enumerate(first_hits(few, fans, back_faces, seeds)):
                    place = (ray + k) * self._count + lanes.surfel
                    before = dr.gather(mi.UInt32, self.met, place, still)
                    there = still & (before != NOTHING)
                    stopped = surfel_met(before)
                    held = intersect(records.geometry, dr.select(there, stopped, 0), lanes.origin,
                                     directions[k], records.degree)  # fmt: skip
                    distance = dr.select(there, held.t, dr.inf)
                    tie = (hit.distance == distance) & (hit.surfel < stopped)
                    nearer = still & (hit.surfel != NOTHING) & ((hit.distance < distance) | tie)
                    dr.scatter(self.met, _code(self.tracer, hit, lanes), place, nearer)
                dr.eval(self.met)

    def _trace_again(self, before: mi.UInt32, changed: mi.Bool) -> None:
        """Trace again, one by one, the rays of moved surfels and the rays that had met one."""
        every = dr.arange(mi.UInt32, dr.width(before))
        # In the hierarchy's order, so that neighbours are traced together.
        surfel = dr.gather(mi.UInt32, self.tracer.bvh.order, every % self._count)
        ray = every // self._count
        met = dr.gather(mi.UInt32, before, ray * self._count + surfel)
        hit = dr.gather(mi.Bool, changed, surfel_met(met), met != NOTHING)
        again = dr.compress(hit | dr.gather(mi.Bool, changed, surfel))
        for first in range(0, dr.width(again), AT_ONCE):
            lane = dr.arange(mi.UInt32, min(AT_ONCE, dr.width(again) - first)) + dr.opaque(mi.UInt32, first)
            which = dr.gather(mi.UInt32, again, lane)
            surfel = dr.gather(mi.UInt32, self.tracer.bvh.order, which % self._count)
            ray = which // self._count
            lanes = self._lanes(surfel, dr.full(mi.Bool, True, dr.width(lane)))
            direction, seed = self._ray(lanes, ray)
            (hit,) = self.tracer.first_hits(lanes.origin, [direction], [lanes.active], [seed], lanes.normal)
            dr.scatter(self.met, _code(self.tracer, hit, lanes), ray * self._count + surfel)
            dr.eval(self.met)


def surfel_met(code: mi.UInt32) -> mi.UInt32:
    """The surfel of a code of :attr:`SurfelRays.met` that is not ``NOTHING``."""
    return (code & (OWN - 1)) >> 1


# Jitter puts some surfels of a sheet's other layer, or of a ray's own, slightly above its origin. Beyond the
# tolerance of :func:`tron.tracing.hierarchy.transmittance.blocks` they stop the ray and show the light of
# the sheet's other side: 4 % of a lamp behind two white layers without a gap. Such a hit is on the sheet's
# wrong side and in its plane. It is treated as the face that the ray has left.


def _code(tracer: SurfelTracer, hit: FirstHit, lanes: _Lanes) -> mi.UInt32:
    """Encode hits of the rays of ``lanes`` as in :attr:`SurfelRays.met`."""
    met = hit.surfel != NOTHING
    there = centres(tracer.records, hit.surfel, met)
    radius = dr.gather(mi.Float, tracer.records.geometry, hit.surfel * (4 * GEOMETRY_PACKETS) + RADIUS, met)
    reach = OWN_SPACINGS / BACK_FACE_SPACINGS * tracer.back_faces.radii * radius
    along, aside = dr.dot(there.normal, lanes.normal), dr.dot(there.normal, there.position - lanes.origin)
    wrong = dr.select(hit.front, -along, along) > OWN_COSINE
    own = met & wrong & (dr.abs(aside) < reach) & (reach < dr.inf)
    code = 2 * hit.surfel + dr.select(hit.front, mi.UInt32(0), 1) + dr.select(own, mi.UInt32(OWN), 0)
    return dr.select(met, code, NOTHING)


def _changed(before: SurfelRecords, now: SurfelRecords) -> mi.Bool:
    """Surfels whose place, orientation, size or opacity has changed."""
    surfel, same = dr.arange(mi.UInt32, now.count), mi.Bool(True)
    for packet in range(GEOMETRY_PACKETS):
        index = surfel * GEOMETRY_PACKETS + packet
        pairs = [dr.gather(mi.Vector4f, records.geometry, index) for records in (before, now)]
        same &= dr.all(pairs[0] == pairs[1])
    changed = ~same
    dr.eval(changed)
    return changed


def _hierarchy_of(records: SurfelRecords, surfel: mi.UInt32) -> Bvh:
    """A hierarchy of some surfels, which keep their numbers."""
    count = dr.width(surfel)
    geometry = dr.empty(mi.Float, 4 * GEOMETRY_PACKETS * count)
    for packet in range(GEOMETRY_PACKETS):
        value = dr.gather(mi.Vector4f, records.geometry, surfel * GEOMETRY_PACKETS + packet)
        dr.scatter(geometry, value, dr.arange(mi.UInt32, count) * GEOMETRY_PACKETS + packet)
    dr.eval(geometry)
    few = build_bvh(replace(records, geometry=geometry, count=count))
    order = dr.gather(mi.UInt32, surfel, few.order)
    dr.eval(order)
    return replace(few, order=order)
