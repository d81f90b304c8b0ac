"""Transmittance along arbitrary rays: a product over hits, so the order in which they are hit is free.

Sidedness (conventions.md, 8): one-sided surfels leak, because undersides that no camera saw do not
exist; naive two-sided surfels darken their own surface. So back faces block only beyond two surfel spacings,
where they can no longer belong to the surface that the ray left. Where surfels are larger than the scene's
median, their spacing is larger by as much (:class:`BackFaces`).

Front faces block from t = 0, but for those of a thin sheet's other side. Its surfels lie back to back with
those that a ray leaves, and jitter puts some on the wrong side: the ray meets their front. They face against
the surface that it leaves, and its origin is next to their plane: within half a spacing, such a
front nearer than two along the ray does not block. Those spacings are the surfel's own, smaller where
it is: fine things in a coarse scene have gaps of less than the scene's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.tracing.hierarchy.bvh import Bvh
from tron.tracing.hierarchy.traversal import any_of, walk
from tron.tracing.kernel import GEOMETRY_PACKETS, RADIUS, SurfelHit, SurfelRecords, intersect

OPAQUE_TRANSMITTANCE = 1e-2
"""Below this a ray counts as blocked: the result is exactly 0, whatever the order of the hits was."""
BACK_FACE_SPACINGS = 2.0
SHEET_SPACINGS = 0.5
"""Distance of a ray's origin from the plane of a front face within which that may be a sheet's other side."""
AGAINST = 0.7
"""Least cosine, negated, between the normals of a sheet's sides."""


@dataclass
class Fans:
    """Shadow rays, a fan of them from each origin.

    Attributes:
        origin: world, one a lane.
        directions: unit, world, of the rays that leave it: close to each other, for speed.
        active: the lanes of each direction to trace; transmittance of the others is 1.
        normal: unit, world, of the surface that they leave; 0 where they leave none.
    """

    origin: mi.Point3f
    directions: Sequence[mi.Vector3f]
    active: Sequence[mi.Bool]
    normal: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))


@dataclass
class Products:
    """Transmittance so far of each ray of a fan; a blocked ray's interval is empty."""

    product: list[mi.Float]
    nearest: list[mi.Float]
    farthest: list[mi.Float]

    @staticmethod
    def clear(active: Sequence[mi.Bool]) -> Products:
        """Nothing hit yet, by the rays that are traced."""
        return Products(
            product=[mi.Float(1) for _ in active],
            nearest=[mi.Float(0) for _ in active],
            farthest=[dr.select(mi.Bool(lanes), mi.Float(dr.inf), -dr.inf) for lanes in active],
        )


@dataclass
class BackFaces:
    """From where on back faces block: one lane each.

    Attributes:
        distance: from the ray's origin, world units, for surfels up to the median size.
        radii: from the ray's origin, in radii of the surfel, for larger ones, and for a sheet's other side of
            all; infinity in both for never.
    """

    distance: mi.Float
    radii: mi.Float

    @staticmethod
    def never() -> BackFaces:
        """Back faces that block nowhere: one-sided surfels."""
        return BackFaces(dr.opaque(mi.Float, dr.inf), dr.opaque(mi.Float, dr.inf))

    @staticmethod
    def of(records: SurfelRecords, spacing: float) -> BackFaces:
        """Two spacings, which are ``spacing`` (world units) where surfels have their median size."""
        radii = np.array(dr.detach(records.geometry)).reshape(-1, 4 * GEOMETRY_PACKETS)[:, RADIUS]
        median = float(np.median(radii[radii > 0])) if (radii > 0).any() else 1.0
        reach = BACK_FACE_SPACINGS * spacing
        return BackFaces(dr.opaque(mi.Float, reach), dr.opaque(mi.Float, reach / median))


def blocks(hit: SurfelHit, back_faces: BackFaces, normal: mi.Vector3f) -> mi.Bool:
    """Whether a surfel stands in the ray's way: the rule of sidedness above; ``normal`` of :class:`Fans`."""
    local = back_faces.radii * hit.radius
    far = dr.select(local > back_faces.distance, local, back_faces.distance)
    # By squares, for a stored normal is not unit: the origin's distance from the plane, the angle between.
    length2, aside, along = dr.squared_norm(hit.normal), hit.t * hit.facing, dr.dot(hit.normal, normal)
    sheet = SHEET_SPACINGS / BACK_FACE_SPACINGS * local
    other_side = (
        (along < 0) & (along * along > AGAINST**2 * length2) & (aside * aside < sheet * sheet * length2)
    )
    before = hit.front & (hit.t > 0) & ~(other_side & (hit.t <= local) & (local < dr.inf))
    return hit.within & (before | (hit.t > far))


def remaining(product: mi.Float) -> mi.Float:
    """A ray's product, or exactly 0 where it counts as blocked."""
    return dr.select(product >= OPAQUE_TRANSMITTANCE, product, 0)


def multiply(
    bvh: Bvh,
    origin: mi.Point3f,
    directions: Sequence[mi.Vector3f],
    back_faces: BackFaces,
    normal: mi.Vector3f,
) -> Callable[[Products, mi.UInt32, mi.Bool], Products]:
    """Visitor of a walk: multiplies by what each surfel lets through."""

    def visit(state: Products, surfel: mi.UInt32, _: mi.Bool) -> Products:
        for ray, direction in enumerate(directions):
            hit = intersect(bvh.geometry, surfel, origin, direction, bvh.degree)
            before = state.product[ray]
            product = dr.select(blocks(hit, back_faces, normal), before * (1 - hit.alpha), before)
            state.product[ray] = product
            state.farthest[ray] = dr.select(product >= OPAQUE_TRANSMITTANCE, state.farthest[ray], -dr.inf)
        return state

    return visit


def transmittance(bvh: Bvh, fans: Fans, back_faces: BackFaces) -> list[mi.Float]:
    """Product of (1 - alpha) over the surfels that block each ray; exactly 0 below ``OPAQUE_TRANSMITTANCE``.

    mi.Float in [0, 1] for each direction. Within recorded loops too; elsewhere
    :func:`tron.tracing.hierarchy.first_hit.queued_transmittance` is faster.
    """
    visit = multiply(bvh, fans.origin, fans.directions, back_faces, fans.normal)
    start, active = Products.clear(fans.active), any_of(fans.active)
    products = walk(bvh, fans.origin, fans.directions, start, visit, active).product
    return [dr.select(lanes, remaining(product), 1) for product, lanes in zip(products, fans.active)]
