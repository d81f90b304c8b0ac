"""The gradient of shadows by opacity, an option: the paper optimises no surfel through its shadow.

With ``T = prod_j (1 - alpha_j)`` and ``alpha_j = o_j response_j``,

    dT/do_j = -T / (1 - alpha_j) response_j

T is known from the forward pass, so a second walk through the hierarchy hits the same surfels, in whatever
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
from tron.tracing.transmittance import BackFaces, Fans, blocks, transmittance
from tron.tracing.traversal import walk

_OPACITY = 3
"""Place of the opacity in a geometry record."""


@dataclass
class _Shadow:
    """Rays of the first walk, as the second needs them."""

    bvh: Bvh
    fans: Fans
    back_faces: BackFaces


@dataclass
class _Whole:
    """A walk that visits everything along the ray."""

    nearest: list[mi.Float]
    farthest: list[mi.Float]


def transmittance_by_opacity(records: SurfelRecords, bvh: Bvh, fans: Fans, back_faces: BackFaces) -> mi.Float:
    """:func:`tron.tracing.transmittance.transmittance` of one ray a lane, differentiable by opacities.

    Args:
        records: the surfels, whose gradients the opacities receive.
        bvh: their hierarchy.
        fans: fans of one ray, detached.
        back_faces: from where on they block.
    """
    return dr.custom(_Transmittance, records.geometry, _Shadow(bvh, fans, back_faces))


class _Transmittance(dr.CustomOp):
    """Geometry records -> transmittance."""

    def eval(self, geometry: Any, shadow: _Shadow) -> Any:
        self.width, self.shadow = dr.width(geometry), shadow
        (self.result,) = transmittance(shadow.bvh, shadow.fans, shadow.back_faces)
        dr.eval(self.result)
        return mi.Float(self.result)

    def backward(self) -> None:
        bvh, fans, target = self.shadow.bvh, self.shadow.fans, dr.zeros(mi.Float, self.width)
        (direction,), (active,) = fans.directions, fans.active
        outer = self.grad_out() * self.result
        dr.eval(outer)

        def visit(state: _Whole, surfel: mi.UInt32, lanes: mi.Bool) -> _Whole:
            hit = intersect(bvh.geometry, surfel, fans.origin, direction, bvh.degree)
            counts = lanes & blocks(hit, self.shadow.back_faces) & (hit.unclipped < MAX_ALPHA)
            by_opacity = -outer * hit.response / (1 - hit.alpha)
            index = dr.gather(mi.UInt32, bvh.order, surfel, counts)
            dr.scatter_reduce(
                dr.ReduceOp.Add, target, by_opacity, index * (4 * GEOMETRY_PACKETS) + _OPACITY, counts
            )
            return state

        start = _Whole([mi.Float(0)], [mi.Float(dr.inf)])
        state = walk(bvh, fans.origin, [direction], start, visit, active & (self.result > 0))
        dr.eval(state, target)
        self.set_grad_in("geometry", target)
