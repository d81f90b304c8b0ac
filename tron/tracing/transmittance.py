"""Transmittance along arbitrary rays: a product over hits, so the order in which they are met is free.

Sidedness (measured in guidance.md): one-sided surfels leak, because undersides that no camera saw do not
exist; naive two-sided surfels darken their own surface. So front faces block from t = 0, and back faces
only beyond two surfel spacings, where they can no longer belong to the surface that the ray left.
"""

# pyright: reportOperatorIssue=false, reportArgumentType=false
# (Mitsuba's type stubs know neither arithmetic between its own array types nor its aliases of Dr.Jit's.)

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from tron.tracing.bvh import Bvh
from tron.tracing.kernel import SurfelHit, intersect
from tron.tracing.traversal import walk

OPAQUE_TRANSMITTANCE = 1e-2
"""Below this a ray counts as blocked: the result is exactly 0, whatever the order of the hits was."""
BACK_FACE_SPACINGS = 2.0


@dataclass
class _Products:
    """Transmittance so far of each ray of a fan; a blocked ray's interval is empty."""

    product: list[mi.Float]
    nearest: list[mi.Float]
    farthest: list[mi.Float]


def blocks(met: SurfelHit, back_faces_from: mi.Float) -> mi.Bool:
    """Whether a surfel stands in the ray's way: the rule of sidedness above."""
    return met.within & (met.t > dr.select(met.front, 0, back_faces_from))


def transmittance(
    bvh: Bvh,
    origin: mi.Point3f,
    directions: Sequence[mi.Vector3f],
    back_faces_from: mi.Float,
    active: Sequence[mi.Bool],
) -> list[mi.Float]:
    """Product of (1 - alpha) over the surfels that block each ray; exactly 0 below ``OPAQUE_TRANSMITTANCE``.

    Args:
        bvh: the hierarchy.
        origin: world. directions: unit, world, of the rays that leave it: close to each other, for speed.
        back_faces_from: distance beyond which back faces block, world units; infinity for one-sided surfels.
        active: the lanes of each direction to trace; the others get 1.

    Returns:
        mi.Float in [0, 1] for each direction.
    """

    def visit(state: _Products, surfel: mi.UInt32, _: mi.Bool) -> _Products:
        for ray, direction in enumerate(directions):
            met = intersect(bvh.geometry, surfel, origin, direction, bvh.degree)
            product = dr.select(
                blocks(met, back_faces_from), state.product[ray] * (1 - met.alpha), state.product[ray]
            )
            state.product[ray] = product
            state.farthest[ray] = dr.select(product >= OPAQUE_TRANSMITTANCE, state.farthest[ray], -1)
        return state

    start = _Products(
        product=[mi.Float(1) for _ in directions],
        nearest=[mi.Float(0) for _ in directions],
        farthest=[dr.select(mi.Bool(lanes), mi.Float(dr.inf), -1) for lanes in active],
    )
    anywhere = mi.Bool(active[0])
    for lanes in active[1:]:
        anywhere |= lanes
    products = walk(bvh, origin, directions, start, visit, anywhere).product
    return [
        dr.select(lanes & (product >= OPAQUE_TRANSMITTANCE), product, dr.select(lanes, 0, mi.Float(1)))
        for product, lanes in zip(products, active)
    ]
