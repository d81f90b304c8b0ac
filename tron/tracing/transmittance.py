"""Transmittance along arbitrary rays: a product over hits, so the order in which they are met is free.

Sidedness (measured in guidance.md): one-sided surfels leak, because undersides that no camera saw do not
exist; naive two-sided surfels darken their own surface. So front faces block from t = 0, and back faces
only beyond two surfel spacings, where they can no longer belong to the surface that the ray left.
"""

# pyright: reportOperatorIssue=false, reportArgumentType=false
# (Mitsuba's type stubs know neither arithmetic between its own array types nor its aliases of Dr.Jit's.)

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from tron.tracing.bvh import LEAF_BIT, Bvh
from tron.tracing.kernel import intersect

OPAQUE_TRANSMITTANCE = 1e-2
"""Below this a ray counts as blocked: the result is exactly 0, whatever the order of the hits was."""
BACK_FACE_SPACINGS = 2.0


def _smaller(a: mi.Float, b: mi.Float) -> mi.Float:
    return dr.select(a < b, a, b)


def _larger(a: mi.Float, b: mi.Float) -> mi.Float:
    return dr.select(a > b, a, b)


def _box_hit(words: list[mi.UInt32], inverse: mi.Vector3f, offset: mi.Vector3f) -> mi.Bool:
    """Slab test of a quantised box; rays in grid coordinates as ``bound * inverse + offset``."""
    entry, leave = mi.Float(0), mi.Float(dr.inf)
    for axis in range(3):
        first = dr.fma(mi.Float(words[axis] & 0xFFFF), inverse[axis], offset[axis])
        second = dr.fma(mi.Float(words[axis] >> 16), inverse[axis], offset[axis])
        entry = _larger(entry, _smaller(first, second))
        leave = _smaller(leave, _larger(first, second))
    return entry <= leave


@dr.syntax
def transmittance(
    bvh: Bvh, origin: mi.Point3f, direction: mi.Vector3f, back_faces_from: mi.Float, active: mi.Bool
) -> mi.Float:
    """Product of (1 - alpha) over the surfels that block each ray; exactly 0 below ``OPAQUE_TRANSMITTANCE``.

    Args:
        bvh: the hierarchy.
        origin: world. direction: unit, world.
        back_faces_from: distance beyond which back faces block, world units; infinity for one-sided surfels.
        active: lanes to trace; the others get 1.

    Returns:
        mi.Float in [0, 1].
    """
    grid_direction = direction * bvh.grid_scale
    tiny = 1e-12
    safe = mi.Vector3f(*[dr.select(dr.abs(v) < tiny, tiny, v) for v in grid_direction])
    inverse = dr.rcp(safe)
    offset = -((origin - bvh.grid_origin) * bvh.grid_scale) * inverse
    product, node = mi.Float(1), mi.UInt32(0)
    going = mi.Bool(active)
    while going:
        words = dr.gather(mi.Vector4u, bvh.nodes, node)
        hit = _box_hit(words, inverse, offset)
        leaf = words[3] >= LEAF_BIT
        surfels = dr.select(hit & leaf & going, words[3] & 15, 0)
        first = (words[3] & (LEAF_BIT - 1)) >> 4
        k = mi.UInt32(0)
        while k < surfels:
            met = intersect(bvh.geometry, first + k, origin, direction, bvh.degree)
            blocks = met.within & (met.t > dr.select(met.front, 0, back_faces_from))
            product = dr.select(blocks, product * (1 - met.alpha), product)
            k += 1
        node = dr.select(hit | leaf, node + 1, words[3])
        going &= (node < bvh.node_count) & (product >= OPAQUE_TRANSMITTANCE)
    return dr.select(product >= OPAQUE_TRANSMITTANCE, product, 0)
