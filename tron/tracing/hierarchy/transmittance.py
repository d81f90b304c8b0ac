"""Transmittance along arbitrary rays: a product over hits, independent of their order.

Sidedness (conventions.md, 8): one-sided surfels leak light, because surfaces that no camera saw from below
have no underside; naive two-sided surfels darken their own surface. So back faces block only beyond two
surfel spacings, where they can no longer belong to the surface that the ray left. For a surfel larger than
the scene's median, the spacing grows in proportion (:class:`BackFaces`).

Front faces block from t = 0, except on a thin sheet's other side. Its surfels lie back to back with those
that a ray leaves, and jitter puts some on the wrong side, so that the ray meets their front. A front face
does not block if it faces against the surface that the ray leaves, the ray's origin is within half a spacing
of its plane, and the hit is nearer than two spacings. These are the surfel's own spacings, because fine
objects in a coarse scene have gaps smaller than the scene's spacing.
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
"""Below this a ray counts as blocked: the result is exactly 0 for any order of the hits."""
BACK_FACE_SPACINGS = 2.0
SHEET_SPACINGS = 0.5
"""Largest distance of a ray's origin from the plane of a front face on a sheet's other side, spacings."""
AGAINST = 0.7
"""Least negated cosine between the normals of a sheet's two sides."""


@dataclass
class Fans:
    """Shadow rays, a fan of them from each origin.

    Attributes:
        origin: world, one per lane.
        directions: unit, world, of the rays from the origin; close to each other, for speed.
        active: for each direction, the lanes to trace; transmittance in the other lanes is 1.
        normal: unit, world, of the surface that the rays leave; 0 if they leave none.
    """

    origin: mi.Point3f
    directions: Sequence[mi.Vector3f]
    active: Sequence[mi.Bool]
    normal: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))


@dataclass
class Products:
    """Transmittance of each ray of a fan so far; a blocked ray's interval is empty."""

    product: list[mi.Float]
    nearest: list[mi.Float]
    farthest: list[mi.Float]

    @staticmethod
    def clear(active: Sequence[mi.Bool]) -> Products:
        """Initial state of the rays to trace: nothing hit yet."""
        return Products(
            product=[mi.Float(1) for _ in active],
            nearest=[mi.Float(0) for _ in active],
            farthest=[dr.select(mi.Bool(lanes), mi.Float(dr.inf), -dr.inf) for lanes in active],
        )


@dataclass
class BackFaces:
    """Distance from the ray's origin beyond which back faces block; one lane each.

    Attributes:
        distance: world units, for surfels up to the median size.
        radii: in radii of the surfel, for larger surfels, and for the sheet rule of all surfels. Infinity in
            both: back faces never block.
    """

    distance: mi.Float
    radii: mi.Float

    @staticmethod
    def never() -> BackFaces:
        """Back faces never block: one-sided surfels."""
        return BackFaces(dr.opaque(mi.Float, dr.inf), dr.opaque(mi.Float, dr.inf))

    @staticmethod
    def of(records: SurfelRecords, spacing: float) -> BackFaces:
        """Back faces block beyond two spacings; ``spacing``, world units, is for surfels of median size."""
        radii = np.array(dr.detach(records.geometry)).reshape(-1, 4 * GEOMETRY_PACKETS)[:, RADIUS]
        median = float(np.median(radii[radii > 0])) if (radii > 0).any() else 1.0
        reach = BACK_FACE_SPACINGS * spacing
        return BackFaces(dr.opaque(mi.Float, reach), dr.opaque(mi.Float, reach / median))


def blocks(hit: SurfelHit, back_faces: BackFaces, normal: mi.Vector3f) -> mi.Bool:
    """Whether a surfel blocks the ray, by the rule of sidedness above; ``normal``: as in :class:`Fans`."""
    local = back_faces.radii * hit.radius
    far = dr.select(local > back_faces.distance, local, back_faces.distance)
    # Distance from the plane and angle, both squared, because stored normals are not of unit length.
    length2, aside, along = dr.squared_norm(hit.normal), hit.t * hit.facing, dr.dot(hit.normal, normal)
    sheet = SHEET_SPACINGS / BACK_FACE_SPACINGS * local
    other_side = (
        (along < 0) & (along * along > AGAINST**2 * length2) & (aside * aside < sheet * sheet * length2)
    )
    before = hit.front & (hit.t > 0) & ~(other_side & (hit.t <= local) & (local < dr.inf))
    return hit.within & (before | (hit.t > far))


def remaining(product: mi.Float) -> mi.Float:
    """A ray's product, or exactly 0 if it counts as blocked."""
    return dr.select(product >= OPAQUE_TRANSMITTANCE, product, 0)


def multiply(
    bvh: Bvh,
    origin: mi.Point3f,
    directions: Sequence[mi.Vector3f],
    back_faces: BackFaces,
    normal: mi.Vector3f,
) -> Callable[[Products, mi.UInt32, mi.Bool], Products]:
    """Visitor of a walk: multiply each ray's product by the surfel's 1 - alpha."""

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

    Returns mi.Float in [0, 1] for each direction. It works within recorded loops; elsewhere
    :func:`tron.tracing.hierarchy.first_hit.queued_transmittance` is faster.
    """
    visit = multiply(bvh, fans.origin, fans.directions, back_faces, fans.normal)
    start, active = Products.clear(fans.active), any_of(fans.active)
    products = walk(bvh, fans.origin, fans.directions, start, visit, active).product
    return [dr.select(lanes, remaining(product), 1) for product, lanes in zip(products, fans.active)]
