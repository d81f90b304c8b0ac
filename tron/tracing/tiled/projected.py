"""Splats projected as in their own viewers: disks parallel to the image plane.

A splat of 3DGS is drawn as the Gaussian that its covariance projects to (Zwicker et al. 2001, EWA splatting;
Kerbl et al. 2023), in the order of centres' depths. A disk through the centre parallel to the image plane
gives the same picture: rays meet all its points at one depth. With a, b and c the splat's two axes and its
thickness projected into the plane at distance 1, by the Jacobian of the projection at its centre, k the pixel
variance in that plane, and L = a_y^2 + b_y^2 + c_y^2,

    A = a_x^2 + b_x^2 + c_x^2 + k_x    B = a_x a_y + b_x b_y + c_x c_y
    D = (a x b)^2 + (b x c)^2 + (c x a)^2 + k_x L + k_y A
    q = X^2 / A + (Y - X B / A)^2 A / D

A and B are the covariance's first row. D is its determinant, without a difference of large numbers, which is
inaccurate for needles. q is the squared distance of a point (X, Y) from the centre, u^2 + v^2 of the record.
The median depth does not come from this disk: :mod:`tron.tracing.surface`.

Splats of 2DGS stay disks in space, with a pixel's filter about their centres at their centres' depths
(:func:`tron.tracing.kernel.intersect`).
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from tron.cameras import Camera
from tron.gaussians.harmonics import sh_basis
from tron.gaussians.projections import Projection
from tron.tracing.compositing import MATERIAL_PACKETS, radiance
from tron.tracing.kernel import (
    FEATURE_PACKETS,
    GEOMETRY_PACKETS,
    MIN_ALPHA,
    SurfelRecords,
    cut_radius_squared,
)
from tron.tracing.parameters import interleave

NEAREST = 0.2
"""Least depth of the centre of a visible splat, world units, as in 3DGS."""
NEAREST_SPACINGS = 20.0
"""Least depth in spacings of splats; the smaller of the two counts, for scans in other units than 3DGS's."""
_OUTSIDE = 1.3
"""Times the image's half width at which the projection's Jacobian is clamped, as in 3DGS."""
_LARGEST = 1e3
"""Largest deviation of a splat, in depths: it covers every picture, and squares stay finite."""
_LEAST_KEPT = 2.5e-5
"""Least ratio of determinants that compensation uses, as in 3DGS."""
_AWAY = 1e-3
"""Cosine up to which a splat seen edge on still counts as facing the camera."""


def projected(
    records: SurfelRecords, camera: Camera, projection: Projection, nearest: float, thickness: mi.Float
) -> SurfelRecords:
    """Turn surfels into disks that show their projections, with SH colour evaluated towards their centres.

    Differentiable in the records; the thickness is a constant.

    Args:
        records: disks in space. camera: the view.
        projection: of the program that trained the splats.
        nearest: least depth of the centre of a visible splat, world units.
        thickness: deviations along the normals, world units; disks of 2DGS have none.
    """
    eye = mi.Point3f([float(v) for v in camera.position])
    right, down, forward = (mi.Vector3f([float(v) for v in row]) for row in camera.world_to_camera[:3, :3])
    sides = (camera.cx, camera.width - camera.cx), (camera.cy, camera.height - camera.cy)
    # Of the longer side: stripes of a view that is no higher than wide see splats as the whole does.
    bend = _OUTSIDE * max(max(sides[0]) / camera.fx, max(sides[1]) / camera.fy)
    numbers = (projection.variance / camera.fx**2, projection.variance / camera.fy**2, bend, nearest)
    variance_x, variance_y, bend, near = (mi.Float(float(v)) for v in numbers)
    dr.make_opaque(eye, right, down, forward, variance_x, variance_y, bend, near)

    surfel = dr.arange(mi.UInt32, records.count)
    centre, axis_u, axis_v = (
        dr.gather(mi.Vector4f, records.geometry, surfel * GEOMETRY_PACKETS + k) for k in range(3)
    )
    place = mi.Vector3f(*[centre[k] for k in range(3)])
    to_centre = place - eye
    u_axis, v_axis = (mi.Vector3f(*[axis[k] for k in range(3)]) for axis in (axis_u, axis_v))
    depth = dr.dot(forward, to_centre)
    seen = (depth >= near) & (axis_v.w >= 0)
    normal = dr.normalize(dr.cross(dr.normalize(u_axis), dr.normalize(v_axis)))
    seen &= ~(dr.dot(normal, dr.normalize(to_centre)) > _AWAY)
    z, opacity, pixel = dr.select(seen, depth, 1), centre.w, None
    if projection.larger:  # the filter is round: as of a square pixel of equal area
        along, across, pixel = u_axis, v_axis, forward * dr.sqrt(dr.sqrt(variance_x * variance_y))
        wide = dr.rcp(dr.squared_norm(u_axis)) + dr.rcp(dr.squared_norm(v_axis))
    else:
        x, y = (dr.clip(dr.dot(axis, to_centre) / z, -bend, bend) for axis in (right, down))

        def flat(axis: mi.Vector3f, times: mi.Float) -> mi.Vector2f:
            deviation = axis * (times / z)
            ahead = dr.dot(forward, deviation)
            shown = mi.Vector2f(dr.dot(right, deviation) - x * ahead, dr.dot(down, deviation) - y * ahead)
            length = dr.detach(dr.norm(shown))
            return shown * dr.select(length > _LARGEST, _LARGEST / length, 1)

        a, b = (flat(axis, dr.rcp(dr.squared_norm(axis))) for axis in (u_axis, v_axis))
        c = flat(normal, thickness)
        first = variance_x + a.x * a.x + b.x * b.x + c.x * c.x
        mixed, last = a.x * a.y + b.x * b.y + c.x * c.y, a.y * a.y + b.y * b.y + c.y * c.y
        own = sum(dr.square(p.x * q.y - p.y * q.x) for p, q in ((a, b), (b, c), (c, a)))
        determinant = own + variance_x * last + variance_y * first
        if projection.compensated:
            opacity *= dr.sqrt(dr.maximum(own / determinant, _LEAST_KEPT))
        along = right * (dr.rsqrt(first) / z)
        across = (right * (mixed / first) - down) * (dr.sqrt(first / determinant) / z)
        wide = dr.square(z) * (first + last + variance_y)
    cut = cut_radius_squared(dr.detach(opacity), records.degree, MIN_ALPHA)
    cut = dr.select(seen, cut, -1)
    reach = dr.detach(dr.sqrt(dr.maximum(cut, 0) * wide))
    geometry = interleave([*place, opacity, *along, reach, *across, cut], records.count)

    direction = dr.normalize(to_centre)
    basis = sh_basis(direction.x, direction.y, direction.z)
    shown = [*radiance(records, surfel, basis, seen), mi.Float(0)]
    kept = [
        dr.gather(mi.Vector4f, records.features, surfel * FEATURE_PACKETS + k)
        for k in range(MATERIAL_PACKETS)
    ]
    features = interleave([*kept[0], *kept[1], *shown], records.count)
    dr.eval(geometry, features)
    return replace(
        records,
        geometry=geometry,
        features=features,
        harmonics=dr.zeros(mi.Float, 1),
        sh_degree=0,
        pixel=pixel,
    )
