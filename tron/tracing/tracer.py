"""SurfelTracer: a scene prepared for camera rays (by tiles) and shadow rays (by a hierarchy)."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Self, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.errors import TronError
from tron.gaussians.projections import PROJECTIONS
from tron.runtime import aligned
from tron.tracing.adjoint import attach, has_gradients
from tron.tracing.gbuffer import GBuffer, trace_view
from tron.tracing.hierarchy.bvh import Bvh, build_bvh, refit
from tron.tracing.hierarchy.first_hit import FirstHit, first_hits, queued_transmittance
from tron.tracing.hierarchy.transmittance import BackFaces, Fans, transmittance
from tron.tracing.kernel import CUT, GEOMETRY_PACKETS, SurfelRecords, turned_geometry
from tron.tracing.parameters import SurfelParameters, pack, pack_values
from tron.tracing.surface import Surface, surface
from tron.tracing.tiled.kbuffer import RelistedHits, Search, composite_rounds, lanes_of, search_hierarchy
from tron.tracing.tiled.projected import NEAREST, NEAREST_SPACINGS, projected

if TYPE_CHECKING:
    from tron.cameras import Camera
    from tron.gaussians.scene import GaussianScene


_PLACES = ("means", "quats", "log_scales", "opacity_logits")
"""The parameters that determine the place and extent of surfels."""
LOOSE_BOXES = 1.5
"""A hierarchy is rebuilt once its boxes' area has grown by this factor since it was built."""


class SurfelTracer:
    """Traces one :class:`GaussianScene`, uploaded and sorted into a hierarchy at once.

    Args:
        scene: the surfels; must be valid (``scene.validate()``) and must not change while the tracer lives
            (:meth:`moved` makes a tracer of moved surfels).
        parameters: traced instead of the scene's own arrays; results are differentiable, repeatedly, by those
            with gradients enabled. Call :meth:`update` after changing values.
        backdrop: (M,) bool, surfels that only cameras see; None: every ray meets all surfels.

    Attributes:
        records: the surfels as every kernel reads them, without gradients. bvh: their hierarchy.
        emission: (M,) mi.Color3f, linear radiance that their fronts emit; None where nothing glows.
    """

    def __init__(
        self,
        scene: GaussianScene,
        *,
        parameters: SurfelParameters | None = None,
        backdrop: np.ndarray | None = None,
    ) -> None:
        self.scene, self._parameters, self._backdrop = scene, parameters, backdrop
        self.emission = _emission(scene)
        self.records = pack(parameters or SurfelParameters.from_scene(scene)).detached()
        # Not built on demand: that may be inside a recorded loop, where nothing can be evaluated.
        self.bvh = build_bvh(self._met())
        self._sorted_area = self.bvh.area
        self._two_sided, self._beyond = True, BackFaces.of(self.records, scene.spacing)

    def moved(self, scene: GaussianScene) -> SurfelTracer:
        """Make a tracer of the same surfels at their new places; this tracer keeps the old ones.

        The hierarchy keeps its order and recomputes its boxes; it is rebuilt once the boxes are so loose that
        sorting anew costs less (``LOOSE_BOXES``).

        Args:
            scene: as many surfels, in the same order (:func:`tron.gaussians.edit.moved`).

        Raises:
            TronError: another number of surfels, or a tracer of ``parameters``.
        """
        if self._parameters is not None:
            raise TronError("this tracer follows parameters", mend="change them and call its update()")
        if len(scene) != len(self.scene):
            raise TronError(
                f"{len(scene)} surfels cannot be where {len(self.scene)} were",
                mend="make a new SurfelTracer where surfels come or go",
            )
        before, other = self.scene, copy(self)
        degree = self.records.sh_degree if scene.sh is before.sh else None
        other.scene, records = scene, pack(SurfelParameters.from_scene(scene, degree))
        if scene.emission is not before.emission:
            other.emission = _emission(scene)
        stay = all(np.array_equal(getattr(scene, name), getattr(before, name)) for name in _PLACES)
        if stay and scene.kernel_degree == before.kernel_degree:  # the hierarchy depends on places alone
            other.records = records
        else:
            other._take(records)
        return other

    def sided(self, two_sided: bool) -> Self:
        """The same surfels under a rule for shadow rays: back faces block beyond two spacings, or never.

        By default they block; the paper's rule is that they never do. Call it again after :meth:`update`.
        """
        if two_sided == self._two_sided:
            return self
        other = copy(self)
        other._two_sided = two_sided
        return other

    def turned_over(self, which: np.ndarray | None = None) -> Self:
        """The same surfels in the same hierarchy with front and back exchanged; without gradients.

        ``which``: (M,) bool, the surfels to turn over; None: all.
        """
        which = np.ones(len(self.scene), bool) if which is None else which
        other, turned = copy(self), mi.Bool(aligned(which))
        other.scene, other._parameters = self.scene.turned_over(which), None
        other.records = self.records.turned_over(turned)
        in_order = dr.gather(mi.Bool, turned, self.bvh.order)
        other.bvh = replace(self.bvh, geometry=turned_geometry(self.bvh.geometry, in_order))
        return other

    def update(self) -> None:
        """Read the new values of ``parameters``: the same number of surfels, which may have moved."""
        if self._parameters is not None:
            with dr.suspend_grad():
                self._take(pack(self._parameters).detached())

    def _take(self, records: SurfelRecords) -> None:
        self.records = records
        self.bvh = refit(self.bvh.order, self.bvh.levels, self._met())
        if bool((self.bvh.area > LOOSE_BOXES * self._sorted_area)[0]):
            self.bvh = build_bvh(self._met())
            self._sorted_area = self.bvh.area

    def _met(self) -> SurfelRecords:
        """The records for all rays but a camera's, in which surfels of the backdrop count nowhere."""
        if self._backdrop is None:
            return self.records
        geometry = dr.copy(self.records.geometry)
        surfel = mi.UInt32(aligned(np.flatnonzero(self._backdrop).astype(np.uint32)))
        dr.scatter(geometry, mi.Float(-1), surfel * (4 * GEOMETRY_PACKETS) + CUT)
        dr.eval(geometry)
        return replace(self.records, geometry=geometry)

    def attached(self) -> SurfelRecords:
        """The records, attached to the parameters that have gradients enabled.

        Packed anew each time, because a backward pass frees the edges between parameters and records.
        """
        if self._parameters is None or not self._parameters.differentiable():
            return self.records
        return pack(self._parameters)

    def _with(self, values: Sequence[mi.Float]) -> SurfelRecords:
        """The records with ``values`` to composite, followed by emission if any surfel emits."""
        glow = () if self.emission is None else self.emission
        return pack_values(self.attached(), [*values, *glow])

    @property
    def back_faces(self) -> BackFaces:
        return self._beyond if self._two_sided else BackFaces.never()

    def gbuffer(
        self, camera: Camera, values: Sequence[mi.Float] = (), limit: mi.Float | None = None
    ) -> GBuffer:
        """Trace, composite and normalise the view of ``camera``, to which back-facing surfels are invisible.

        Surfels are drawn by the scene's ``projection``, as a scan's own viewer does, or as disks in space.

        Args:
            camera: the view.
            values: quantities to composite like the materials, each an array of one number per surfel in the
                scene's order. The results are in ``GBuffer.values``, differentiable.
            limit: distance along each ray, in tile order, of an opaque surface that hides all surfels behind
                it, world units; None: there is none.
        """
        records = self._with(values)
        projection = PROJECTIONS[self.scene.projection]
        if projection is None:
            return _with_emission(trace_view(records, camera, limit), self.emission)
        nearest = min(NEAREST, NEAREST_SPACINGS * self.scene.spacing)
        deviations = np.exp(self.scene.log_thickness)
        thickness = mi.Float(aligned(deviations) if len(deviations) else 0)
        seen = projected(records, camera, projection, nearest, thickness)
        return _with_emission(trace_view(seen, camera, limit, records), self.emission)

    def trace(
        self,
        origin: mi.Point3f,
        direction: mi.Vector3f,
        active: mi.Bool | bool = True,
        values: Sequence[mi.Float] = (),
    ) -> Surface:
        """Surfaces along any rays, from ``origin`` along unit ``direction``; inactive lanes see nothing.

        Composites the same surfels in the same order as :meth:`gbuffer`, with the same ``values``; slower,
        because arbitrary rays lack the coherence of camera rays.
        """
        records = self._with(values)
        seen = trace_rays(records, self.bvh, origin, direction, mi.Bool(active))
        return _with_emission(seen, self.emission)

    def first_hits(
        self,
        origin: mi.Point3f,
        directions: Sequence[mi.Vector3f],
        active: Sequence[mi.Bool],
        seeds: Sequence[mi.UInt32],
        normal: mi.Vector3f | None = None,
    ) -> list[FirstHit]:
        """Draw one surfel per ray with the probability of its compositing weight: see :mod:`.first_hit`.

        Takes a fan of rays from each origin (:class:`Fans`); sides count as for shadow rays. ``seeds`` come
        from :func:`tron.tracing.hierarchy.first_hit.ray_seeds`.
        """
        fans = Fans(origin, directions, active, mi.Vector3f(0) if normal is None else normal)
        return first_hits(self.bvh, fans, self.back_faces, seeds)

    def transmittance(
        self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool | bool = True
    ) -> mi.Float:
        """Transmittance from ``origin`` to infinity along unit ``direction``; exactly 0 below 0.01."""
        return self.transmittances(Fans(origin, [direction], [mi.Bool(active)]))[0]

    def transmittances(self, fans: Fans) -> list[mi.Float]:
        """Transmittance of a fan of rays from each origin; the closer its rays, the faster.

        The other side of a thin sheet that they leave does not block them. Evaluated at once, except within a
        recorded loop.
        """
        recorded = dr.flag(dr.JitFlag.SymbolicScope)
        trace = transmittance if recorded else queued_transmittance
        return trace(self.bvh, fans, self.back_faces)


def _emission(scene: GaussianScene) -> mi.Color3f | None:
    """(M,) linear radiance that the surfels' fronts emit; None where nothing glows."""
    emission = scene.emission
    return mi.Color3f(*(mi.Float(aligned(each)) for each in emission.T)) if emission.any() else None


Seen = TypeVar("Seen", bound=Surface)


def _with_emission(seen: Seen, emission: mi.Color3f | None) -> Seen:
    """Move the last three values to the surface's emission, if surfels glow."""
    if emission is None:
        return seen
    return replace(seen, values=seen.values[:-3], emission=mi.Color3f(*seen.values[-3:]))


def trace_rays(
    records: SurfelRecords, bvh: Bvh, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
) -> Surface:
    """Trace, composite and normalise; differentiable in the records and, only through SH, in ``direction``.

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
    return surface(sums, records, at, along)
