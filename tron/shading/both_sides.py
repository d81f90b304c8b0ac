"""Light that bounces between surfels whose normals have no sign, as in plain files of 3DGS.

Each surfel has two faces with light of their own, whichever way its normal was turned: M surfels are 2 M
faces, and a ray that meets a surfel meets the face on its side. Transport is traced once for the scene and
once for the scene turned over; a camera is then given the faces that it sees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.estimation import FINAL, Estimation
from tron.shading.bounce import RAYS, BouncedLight, BounceTransport
from tron.shading.lighting import Lighting
from tron.tracing.first_hit import NOTHING
from tron.tracing.tracer import SurfelTracer


@dataclass
class BothSides:
    """Transport of both faces of M surfels; make one by :meth:`trace`.

    Attributes:
        front: of the faces that the normals point away from, as if there were no others.
        back: of the others.
        faces: of all 2 M, fronts first; no ray meets a back.
    """

    front: BounceTransport
    back: BounceTransport
    faces: BounceTransport

    @classmethod
    def trace(
        cls,
        tracer: SurfelTracer,
        rays: int = RAYS,
        seed: int = 0,
        track: Callable[[range], Iterable[int]] = iter,
    ) -> BothSides:
        """Trace ``rays`` rays of each face; arguments and errors as of :meth:`BounceTransport.trace`."""
        scene = tracer.scene
        over = SurfelTracer(scene.turned_over(np.ones(len(scene), bool)))
        front, back = (BounceTransport.trace(side, rays, seed, track) for side in (tracer, over))
        met = _of_faces(front.rays.met, back.rays.met, len(scene))
        return cls(front, back, BounceTransport(front.rays.meeting(met)))

    def bake(
        self, lighting: Lighting, estimation: Estimation = FINAL, seed: int = 0
    ) -> tuple[BouncedLight, BouncedLight]:
        """Light of ``lighting`` at the fronts, and at the backs: see :meth:`BounceTransport.bake`."""
        sides = [side.bake(lighting, estimation, bounces=0, seed=seed) for side in (self.front, self.back)]
        albedo = self.front.albedo(estimation.diffuse)
        albedo, direct = _joined(albedo, albedo), _joined(*(side.direct for side in sides))
        indirect = self.faces.indirect(direct, albedo, estimation.bounces)
        outgoing = albedo * (direct + indirect)
        count = len(self.front.tracer.scene)
        for number, side in enumerate(sides):
            face = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, number * count)
            side.indirect = dr.gather(mi.Color3f, indirect, face)
            side.outgoing = dr.gather(mi.Color3f, outgoing, face)
        dr.eval(sides)
        return sides[0], sides[1]


def _of_faces(front: mi.UInt32, back: mi.UInt32, count: int) -> mi.UInt32:
    """Codes of ``SurfelRays.met`` for the rays of all faces, from those of either side."""
    surfels = dr.opaque(mi.UInt32, count)
    place = dr.arange(mi.UInt32, dr.width(front) + dr.width(back))
    ray, face = place // (2 * surfels), place % (2 * surfels)
    over = face >= surfels
    own = ray * surfels + dr.select(over, face - surfels, face)
    code = dr.select(over, dr.gather(mi.UInt32, back, own, over), dr.gather(mi.UInt32, front, own, ~over))
    other = over ^ ((code & 1) == 1)
    met = dr.select(code == NOTHING, NOTHING, 2 * ((code >> 1) + dr.select(other, surfels, 0)))
    dr.eval(met)
    return met


def _joined(fronts: mi.Color3f, backs: mi.Color3f) -> mi.Color3f:
    return mi.Color3f(*(dr.concat([front, back]) for front, back in zip(fronts, backs, strict=True)))


def facing(fronts: BouncedLight, backs: BouncedLight, turned: np.ndarray) -> BouncedLight:
    """Of each surfel the light of its front, or where it is ``turned`` over, (M,) bool, of its back."""
    over, front = mi.Bool(turned), vars(fronts)
    shown = BouncedLight(**{name: dr.select(over, light, front[name]) for name, light in vars(backs).items()})
    shown.behind = dr.select(over, fronts.outgoing, backs.outgoing)
    dr.eval(shown)
    return shown
