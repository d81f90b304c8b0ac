"""SurfelTracer: a scene made ready for camera rays (by tiles) and shadow rays (by a hierarchy)."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from tron.errors import TronError
from tron.tracing.bvh import build_bvh, refit
from tron.tracing.first_hit import FirstHit, first_hits
from tron.tracing.gbuffer import GBuffer, trace_gbuffer
from tron.tracing.kernel import SurfelRecords
from tron.tracing.parameters import SurfelParameters, pack, pack_values
from tron.tracing.rays import trace_rays
from tron.tracing.shadow_gradient import transmittance_by_opacity
from tron.tracing.shadow_queue import queued_transmittance
from tron.tracing.surface import Surface
from tron.tracing.tiles import build_tiles
from tron.tracing.transmittance import BackFaces, Fans, transmittance

if TYPE_CHECKING:
    from tron.cameras import Camera
    from tron.gaussians.scene import GaussianScene


LOOSE_BOXES = 1.5
"""A hierarchy is built anew once its boxes' area is this many times what it was when it was last built."""


class SurfelTracer:
    """Traces one :class:`GaussianScene`, uploaded and sorted into a hierarchy at once.

    Args:
        scene: the surfels; must be valid (``scene.validate()``), and must not change while the tracer lives:
            for surfels that move there is :meth:`moved`.
        parameters: traced instead of the scene's own arrays; results are differentiable by those of them that
            have gradients enabled, as often as they are asked for. After new values, :meth:`update`.

    Attributes:
        records: the surfels as every kernel reads them, without gradients. bvh: their hierarchy.
    """

    def __init__(self, scene: GaussianScene, *, parameters: SurfelParameters | None = None) -> None:
        self.scene, self._parameters = scene, parameters
        self.records = pack(parameters or SurfelParameters.from_scene(scene)).detached()
        # Not built when first needed: that may be inside a recorded loop, where nothing can be evaluated.
        self.bvh = build_bvh(self.records)
        self._sorted_area = self.bvh.area
        self._two_sided, self._beyond = True, BackFaces.of(self.records, scene.spacing)

    def moved(self, scene: GaussianScene) -> SurfelTracer:
        """A tracer of the same surfels where they are now; this one goes on tracing where they were.

        Their order in the hierarchy is kept and its boxes are made anew, unless they have grown so loose that
        sorting costs less than tracing on (``LOOSE_BOXES``).

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
        other = copy(self)
        other.scene = scene
        other._take(pack(SurfelParameters.from_scene(scene)))
        return other

    def sided(self, two_sided: bool) -> SurfelTracer:
        """The same surfels for shadow rays of other sides: back faces block beyond two spacings, or never.

        A new tracer lets them block; that they never do is the paper's rule. Ask again after :meth:`update`.
        """
        if two_sided == self._two_sided:
            return self
        other = copy(self)
        other._two_sided = two_sided
        return other

    def update(self) -> None:
        """Take the new values of ``parameters``: as many surfels, which may have moved."""
        if self._parameters is not None:
            with dr.suspend_grad():
                self._take(pack(self._parameters).detached())

    def _take(self, records: SurfelRecords) -> None:
        self.records = records
        self.bvh = refit(self.bvh.order, self.bvh.levels, records)
        if bool((self.bvh.area > LOOSE_BOXES * self._sorted_area)[0]):
            self.bvh = build_bvh(records)
            self._sorted_area = self.bvh.area

    def attached(self) -> SurfelRecords:
        """The records, attached to the parameters that have gradients enabled.

        Packed anew each time, because a backward pass frees the edges between parameters and records.
        """
        if self._parameters is None or not self._parameters.differentiable():
            return self.records
        return pack(self._parameters)

    @property
    def back_faces(self) -> BackFaces:
        return self._beyond if self._two_sided else BackFaces.never()

    def gbuffer(self, camera: Camera, values: Sequence[mi.Float] = ()) -> GBuffer:
        """Trace, composite and normalise what ``camera`` sees. Back-facing surfels are invisible to it.

        ``values``: quantities of the surfels to composite as their materials are, each an array of one number
        a surfel in the scene's order. They come back in ``GBuffer.values``, differentiable.
        """
        records = pack_values(self.attached(), values)
        return trace_gbuffer(records, build_tiles(self.records, camera), camera)

    def trace(
        self,
        origin: mi.Point3f,
        direction: mi.Vector3f,
        active: mi.Bool | bool = True,
        values: Sequence[mi.Float] = (),
    ) -> Surface:
        """Surfaces along any rays, from ``origin`` along unit ``direction``; inactive lanes see nothing.

        The same surfels composited in the same order as by :meth:`gbuffer`, without the coherence that makes
        camera rays fast; ``values`` as there.
        """
        records = pack_values(self.attached(), values)
        return trace_rays(records, self.bvh, origin, direction, mi.Bool(active))

    def first_hits(
        self,
        origin: mi.Point3f,
        directions: Sequence[mi.Vector3f],
        active: Sequence[mi.Bool],
        seeds: Sequence[mi.UInt32],
    ) -> list[FirstHit]:
        """One surfel a ray, by chance, each as likely as its weight in compositing: see :mod:`.first_hit`.

        For a fan of rays from each origin, as :meth:`transmittances` has them; back faces count as for shadow
        rays. ``seeds`` of each ray: :func:`tron.tracing.first_hit.ray_seeds`.
        """
        return first_hits(self.bvh, Fans(origin, directions, active), self.back_faces, seeds)

    def transmittance(
        self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool | bool = True
    ) -> mi.Float:
        """Transmittance from ``origin`` to infinity along unit ``direction``; exactly 0 below 0.01."""
        return self.transmittances(origin, [direction], [mi.Bool(active)])[0]

    def transmittances(
        self, origin: mi.Point3f, directions: Sequence[mi.Vector3f], active: Sequence[mi.Bool]
    ) -> list[mi.Float]:
        """The same for a fan of rays from each origin: quicker together, the more so the closer they are.

        Evaluated at once, unless within a recorded loop.
        """
        recorded = dr.flag(dr.JitFlag.SymbolicScope)
        trace = transmittance if recorded else queued_transmittance
        return trace(self.bvh, Fans(origin, directions, active), self.back_faces)

    def transmittance_by_opacity(
        self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool | bool = True
    ) -> mi.Float:
        """:meth:`transmittance`, differentiable by the opacities; not inside a recorded loop."""
        fans = Fans(dr.detach(origin), [dr.detach(direction)], [mi.Bool(active)])
        return transmittance_by_opacity(self.attached(), self.bvh, fans, self.back_faces)
