"""A tracer for surfels with meshes beside them.

Every ray of light meets the meshes first, by one test, and the surfels if it passes. Rays that look for what
they meet, of bounces and reflections, meet the surfels that stand for the meshes
(:class:`tron.tracing.meshes.Meshes`), whose numbers follow those of the surfels that light sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol, Self

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.gaussians.edit import joined, with_kernel
from tron.shading.direct.irradiance import Occluder
from tron.tracing import GBuffer, SurfelTracer
from tron.tracing.hierarchy.first_hit import FirstHit
from tron.tracing.hierarchy.transmittance import Fans
from tron.tracing.meshes import Meshes
from tron.tracing.tiled.kbuffer import lanes_of

if TYPE_CHECKING:
    from tron.cameras import Camera


class LimitedTracer(Occluder, Protocol):
    """Protocol of the tracers of surfels for one camera: ``SurfelTracer`` and ``ProxiedTracer``."""

    def sided(self, two_sided: bool) -> LimitedTracer: ...

    def gbuffer(
        self, camera: Camera, values: Sequence[mi.Float] = (), limit: mi.Float | None = None
    ) -> GBuffer: ...


def transmittances_past(meshes: Meshes, surfels: Occluder, fans: Fans) -> list[mi.Float]:
    """Return ``surfels.transmittances`` for rays that no mesh blocks, and 0 for the others."""
    lanes = [mi.Bool(each) for each in fans.active]
    passing = [
        each & ~meshes.blocked(fans.origin, along, each) for along, each in zip(fans.directions, lanes)
    ]
    dr.eval(passing)
    found = surfels.transmittances(replace(fans, active=passing))
    return [dr.select(each & ~free, 0, value) for each, free, value in zip(lanes, passing, found)]


class LightTracer(SurfelTracer):
    """Surfels for bounced light: first those of a scene, then surfels that stand for the meshes.

    Shadow rays meet the scene's surfels and the meshes themselves.

    Args:
        surfels: that light sees.
        meshes: beside them.
        backdrop: (M,) bool, of the scene, as of :class:`SurfelTracer`.
    """

    def __init__(self, surfels: SurfelTracer, meshes: Meshes, backdrop: np.ndarray | None = None) -> None:
        if backdrop is not None:
            backdrop = np.append(backdrop, np.zeros(len(meshes.stand_ins), bool))
        stand_ins = with_kernel(meshes.stand_ins, surfels.scene.kernel_degree)
        super().__init__(joined(surfels.scene, stand_ins), backdrop=backdrop)
        self.surfels, self.meshes = surfels, meshes

    def sided(self, two_sided: bool) -> Self:
        """:meth:`SurfelTracer.sided`."""
        other = copy(super().sided(two_sided))
        other.surfels = self.surfels.sided(two_sided)
        return other

    def turned_over(self, which: np.ndarray | None = None) -> Self:
        """:meth:`SurfelTracer.turned_over`."""
        other, count = copy(super().turned_over(which)), len(self.surfels.scene)
        other.surfels = self.surfels.turned_over(None if which is None else which[:count])
        return other

    def transmittances(self, fans: Fans) -> list[mi.Float]:
        """:meth:`SurfelTracer.transmittances`."""
        return transmittances_past(self.meshes, self.surfels, fans)


class BesideMeshes:
    """Tracer of surfels and meshes for a camera; has the interface of ``SurfelTracer``.

    Args:
        seen: the surfels as a camera sees them.
        light: the surfels that light sees, and the meshes.

    Attributes:
        scene, records: of ``light``, whom :meth:`first_hits` numbers.
    """

    def __init__(self, seen: LimitedTracer, light: LightTracer) -> None:
        self._seen, self._light = seen, light
        self.scene, self.records = light.scene, light.records

    def sided(self, two_sided: bool) -> BesideMeshes:
        """Return a copy with other blocking sides for shadow rays: :meth:`SurfelTracer.sided`."""
        return BesideMeshes(self._seen.sided(two_sided), self._light.sided(two_sided))

    def gbuffer(self, camera: Camera, values: Sequence[mi.Float] = ()) -> GBuffer:
        """Trace the camera's G-buffer; ``values`` are those of all surfels of ``light``."""
        meshes, count = self._light.meshes, len(self._light.surfels.scene)
        layer = meshes.seen(camera, self.scene.spacing)
        fronts = [some_of(value, 0, count) for value in values]
        stand_ins = [some_of(value, count, len(meshes.stand_ins)) for value in values]
        surfels = self._seen.gbuffer(camera, fronts, layer.limit)
        return layer.behind(surfels, meshes.values_at(camera, layer, stand_ins))

    def first_hits(
        self,
        origin: mi.Point3f,
        directions: Sequence[mi.Vector3f],
        active: Sequence[mi.Bool],
        seeds: Sequence[mi.UInt32],
        normal: mi.Vector3f | None = None,
    ) -> list[FirstHit]:
        """:meth:`SurfelTracer.first_hits` among the surfels of ``light``."""
        return self._light.first_hits(origin, directions, active, seeds, normal)

    def transmittances(self, fans: Fans) -> list[mi.Float]:
        """Return transmittances through the meshes and the surfels that a camera sees."""
        return transmittances_past(self._light.meshes, self._seen, fans)


def some_of(values: mi.Float, first: int, count: int) -> mi.Float:
    """Return ``count`` of the numbers from ``first`` on; a single number is returned as it is."""
    return lanes_of(values, dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first))
