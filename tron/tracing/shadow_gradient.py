"""The gradient of shadows by opacity, an option: the paper optimises no surfel through its shadow.

With ``T = prod_j (1 - alpha_j)`` and ``alpha_j = o_j response_j``,

    dT/do_j = -T / (1 - alpha_j) response_j

T is known from the forward pass, so a second walk through the hierarchy meets the same surfels, in whatever
order, and adds this up at each. Opacity alone is differentiated. The derivative is exactly zero where the ray
is blocked (T below 0.01 counts as 0) and where alpha is clipped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from tron.tracing.bvh import Bvh
from tron.tracing.kernel import GEOMETRY_PACKETS, MAX_ALPHA, SurfelRecords, intersect
from tron.tracing.transmittance import BackFaces, blocks, transmittance
from tron.tracing.traversal import walk

_OPACITY = 3
"""Where a geometry record holds the opacity."""


@dataclass
class _Shadow:
    """What the second walk needs to know of the first."""

    bvh: Bvh
    origin: mi.Point3f
    direction: mi.Vector3f
    back_faces: BackFaces
    active: mi.Bool


@dataclass
class _Whole:
    """A walk that visits everything along the ray."""

    nearest: list[mi.Float]
    farthest: list[mi.Float]


def transmittance_by_opacity(
    records: SurfelRecords,
    bvh: Bvh,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    back_faces: BackFaces,
    active: mi.Bool,
) -> mi.Float:
    """:func:`tron.tracing.transmittance.transmittance` of one ray a lane, differentiable by opacities.

    Args:
        records: the surfels, whose gradients the opacities receive.
        bvh: their hierarchy. The other arguments are those of ``transmittance``.
    """
    shadow = _Shadow(bvh, dr.detach(origin), dr.detach(direction), back_faces, active)
    return dr.custom(_Transmittance, records.geometry, shadow)


class _Transmittance(dr.CustomOp):
    """Geometry records -> transmittance."""

    def eval(self, geometry: Any, shadow: _Shadow) -> Any:
        self.width, self.shadow = dr.width(geometry), shadow
        (self.result,) = transmittance(
            shadow.bvh, shadow.origin, [shadow.direction], shadow.back_faces, [shadow.active]
        )
        dr.eval(self.result)
        return mi.Float(self.result)

    def backward(self) -> None:
        shadow, target = self.shadow, dr.zeros(mi.Float, self.width)
        outer = self.grad_out() * self.result
        dr.eval(outer)

        def visit(state: _Whole, surfel: mi.UInt32, lanes: mi.Bool) -> _Whole:
            met = intersect(shadow.bvh.geometry, surfel, shadow.origin, shadow.direction, shadow.bvh.degree)
            counts = lanes & blocks(met, shadow.back_faces) & (met.unclipped < MAX_ALPHA)
            by_opacity = -outer * met.response / (1 - met.alpha)
            index = dr.gather(mi.UInt32, shadow.bvh.order, surfel, counts)
            dr.scatter_reduce(
                dr.ReduceOp.Add, target, by_opacity, index * (4 * GEOMETRY_PACKETS) + _OPACITY, counts
            )
            return state

        start = _Whole([mi.Float(0)], [mi.Float(dr.inf)])
        state = walk(
            shadow.bvh, shadow.origin, [shadow.direction], start, visit, shadow.active & (self.result > 0)
        )
        dr.eval(state, target)
        self.set_grad_in("geometry", target)
