"""Sums over hits -> surface points: the normalisation that every ray of the library goes through.

Composited channels are alpha-weighted sums, so materials are divided by opacity and the normal is brought
back to unit length (conventions.md, 7). The surface point is at the median depth; if transmittance never
falls below one half there is no median, and the alpha-weighted mean depth is used where opacity is not zero.
The median depth is measured to the plane of the surfel's own disk, even if the camera draws its projection,
which lies at one depth: shading needs the place of the surface.

If a ray meets both faces of an edge, the mean of their normals reflects lamps that neither face sees. So the
normal, and on a ridge the point, is one face's, unless geometry is differentiated: :func:`_of_one_face`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from tron.tracing.compositing import CHANNELS, NO_SURFEL, Composite
from tron.tracing.kernel import FEATURE_PACKETS, GEOMETRY_PACKETS, SurfelRecords, half_axes

BEYOND = 2.0
"""A disk's plane is followed up to this many times its reach: the pixel's filter widens a projection."""
EVEN, FACES = 0.98, 0.6
"""A ray sees two faces if each face's mean normal has at least the first length and the cosine between them
is below the second: not on a wire four pixels thick, nor in a scan's fog."""
GRAZING = 0.05
"""Cosine to the ray that normals facing away are bent to."""


@dataclass
class Surface:
    """Surface that each ray sees, as Dr.Jit arrays of one lane per ray.

    Attributes:
        position: mi.Point3f, world; meaningless where opacity is 0.
        depth: mi.Float, distance along the unit ray to the median hit, world units; 0 where there is none.
            Not differentiated.
        lift: mi.Float, distance from the first hit after which T < 0.9 to the median hit, a measure of the
            surface's thickness, world units; 0 without a median. Not differentiated.
        normal: mi.Normal3f, unit, world, geometric; zero where opacity is 0. At an edge it is one face's
            normal, or the mean if geometry is differentiated.
        normal_sum: mi.Normal3f, sum of ``w n`` before normalisation: shorter than the opacity where the
            surfels along a ray face different ways.
        base_color: mi.Color3f, linear.
        roughness, metallic: mi.Float.
        rgb: mi.Color3f, composited SH radiance in display space, premultiplied by opacity.
        opacity: mi.Float, 1 - T.
        direction: mi.Vector3f, the unit ray, world.
        values: list of mi.Float, further composited quantities, each in its own unit; empty by default.
        emission: mi.Color3f, linear radiance emitted towards the ray; None if nothing glows.
    """

    position: mi.Point3f
    depth: mi.Float
    lift: mi.Float
    normal: mi.Normal3f
    normal_sum: mi.Normal3f
    base_color: mi.Color3f
    roughness: mi.Float
    metallic: mi.Float
    rgb: mi.Color3f
    opacity: mi.Float
    direction: mi.Vector3f
    values: list[mi.Float]
    emission: mi.Color3f | None = field(default=None, kw_only=True)

    def raised(self, offset: mi.Float) -> mi.Point3f:
        """Origins of rays leaving the surface, ``offset`` above it, world units; not differentiated."""
        return mi.Point3f(dr.detach(self.position)) + mi.Normal3f(dr.detach(self.normal)) * offset


def surface(sums: Composite, records: SurfelRecords, origin: mi.Point3f, direction: mi.Vector3f) -> Surface:
    """Normalise the sums of rays from ``origin`` along unit ``direction``; differentiable in the sums.

    ``records``: the surfels, as disks in space.
    """
    opacity = 1 - sums.transmittance
    hit = opacity > 0
    # Divisors of empty rays are replaced before dividing: 0 times an infinite derivative would be NaN.
    inverse = dr.select(hit, dr.rcp(dr.select(hit, opacity, 1)), 0)
    channels = sums.channels
    normal_sum = mi.Normal3f(*channels[0:3])
    normal, ridge = normal_sum, mi.UInt32(NO_SURFEL)
    if not dr.grad_enabled(records.geometry):  # materials are differentiated through the drawn disks
        normal, ridge = _of_one_face(sums, records, origin, direction)
    squared = dr.squared_norm(normal)
    oriented = squared > 0
    depth = depth_along(records, sums.median, origin, direction)
    distance = dr.select(depth > 0, depth, sums.mean_depth * inverse)
    # From a surfel's overhanging end, a ray along the other face's normal would hit the surfel's neighbours.
    distance = dr.select(ridge != NO_SURFEL, depth_along(records, ridge, origin, direction), distance)
    return Surface(
        position=origin + distance * direction,
        depth=depth,
        lift=dr.select(depth > 0, depth - depth_along(records, sums.begin, origin, direction), 0),
        normal=dr.select(oriented, normal / dr.sqrt(dr.select(oriented, squared, 1)), 0),
        normal_sum=normal_sum,
        base_color=mi.Color3f(*channels[4:7]) * inverse,
        roughness=channels[3] * inverse,
        metallic=channels[7] * inverse,
        rgb=mi.Color3f(*channels[8:11]),
        opacity=opacity,
        direction=direction,
        values=[value * inverse for value in channels[CHANNELS:]],
    )


def _of_one_face(
    sums: Composite, records: SurfelRecords, origin: mi.Point3f, direction: mi.Vector3f
) -> tuple[mi.Normal3f, mi.UInt32]:
    """Sum of ``w n`` over one face if the ray meets two, else over all hits; detached.

    On a ridge, also the surfel whose plane the ray meets; ``NO_SURFEL`` elsewhere.

    Of two faces, the one with the larger weight is chosen. But if each lies behind the other's plane, their
    edge is a ridge and surfels reach past it into the air: a ray enters a convex solid at the later plane.
    """
    every, front = mi.Normal3f(*sums.channels[0:3]), mi.Normal3f(*sums.front[0:3])
    weight, rest = sums.front[3], every - front
    others = 1 - sums.transmittance - weight
    long, short = dr.norm(front), dr.norm(rest)
    two = (long > EVEN * weight) & (short > EVEN * others) & (dr.dot(front, rest) < FACES * long * short)
    geometry, places, radii = dr.detach(records.geometry), [], []
    for surfel in (sums.first, sums.other):
        base = surfel * GEOMETRY_PACKETS
        centre, axis = (dr.gather(mi.Vector4f, geometry, base + k, two) for k in range(2))
        places.append(mi.Vector3f(*[centre[k] for k in range(3)]))
        radii.append(axis.w)
    apart = places[1] - places[0]
    met = dr.dot(front, places[0] - origin) / dr.dot(front, direction) * direction - (places[1] - origin)
    # Height of the first face above the other's plane, where the ray meets it.
    height = dr.dot(rest, met) / short
    ridge = (dr.dot(front, apart) < 0) & (dr.dot(rest, apart) > 0) & (dr.abs(height) < dr.maximum(*radii))
    first = dr.select(ridge, height < 0, weight >= others)
    entered = dr.select(two & ridge, dr.select(first, sums.first, sums.other), mi.UInt32(NO_SURFEL))
    return dr.select(two, dr.select(first, front, rest), every), entered


def depth_along(
    records: SurfelRecords, surfel: mi.UInt32, origin: mi.Point3f, direction: mi.Vector3f
) -> mi.Float:
    """Distance along unit rays to the planes of surfels' disks, detached; 0 without a surfel.

    It is clamped to twice the disk's reach along the ray about its centre, because a plane seen edge on may
    be met anywhere or nowhere.
    """
    some = surfel != NO_SURFEL
    geometry, base = dr.detach(records.geometry), surfel * GEOMETRY_PACKETS
    centre, axis_u, axis_v = (dr.gather(mi.Vector4f, geometry, base + k, some) for k in range(3))
    to_centre = mi.Vector3f(*[centre[k] for k in range(3)]) - dr.detach(origin)
    along = mi.Vector3f(dr.detach(direction))
    u_axis, v_axis = (mi.Vector3f(*[axis[k] for k in range(3)]) for axis in (axis_u, axis_v))
    u, v = (dr.dot(half, along) for half in half_axes(u_axis, v_axis, axis_v.w))
    middle, reach = dr.dot(to_centre, along), BEYOND * dr.sqrt(u * u + v * v)
    normal = dr.cross(u_axis, v_axis)
    beyond = dr.dot(normal, to_centre) / dr.dot(normal, along) - middle
    # For a disk seen exactly edge on this is NaN, and every comparison is false.
    beyond = dr.select(dr.abs(beyond) <= reach, beyond, dr.select(beyond > 0, reach, -reach))
    return dr.select(some, middle + beyond, 0)


def seen_normal(normal: mi.Vector3f, direction: mi.Vector3f) -> mi.Vector3f:
    """Unit normals; those facing away from rays along unit ``direction`` are bent towards them."""
    away = dr.dot(normal, direction)
    bent = dr.normalize(normal - (away + GRAZING) * direction)
    return dr.select(away > 0, bent, normal)


def centres(records: SurfelRecords, surfel: mi.UInt32, active: mi.Bool | bool = True) -> Surface:
    """Centres, unit normals and materials of ``surfel``, one lane each, differentiable in the records.

    Opacity is 1, whatever the surfel's own; 0 in inactive lanes. As there is no ray, depth, lift, direction
    and rgb are 0.
    """
    active = mi.Bool(active)

    def packet(values: mi.Float, index: mi.UInt32) -> mi.Vector4f:
        return dr.gather(mi.Vector4f, values, index, active)

    centre = packet(records.geometry, surfel * GEOMETRY_PACKETS)
    normal, base = (packet(records.features, surfel * FEATURE_PACKETS + k) for k in range(2))
    return Surface(
        position=mi.Point3f(centre.x, centre.y, centre.z),
        depth=mi.Float(0),
        lift=mi.Float(0),
        normal=mi.Normal3f(normal.x, normal.y, normal.z),
        normal_sum=mi.Normal3f(normal.x, normal.y, normal.z),
        base_color=mi.Color3f(base.x, base.y, base.z),
        roughness=normal.w,
        metallic=base.w,
        rgb=mi.Color3f(0),
        opacity=dr.select(active, mi.Float(1), 0),
        direction=mi.Vector3f(0),
        values=[],
    )
