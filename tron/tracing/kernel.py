"""The kernel of a 2D Gaussian surfel: where a ray meets its disk, and the opacity there.

A surfel is a flat Gaussian in the plane of its tangents ``t_u, t_v``. With ``p`` the point where the ray
meets that plane, ``u = (p - c) . t_u / s_u``, ``v = (p - c) . t_v / s_v`` and ``q = u^2 + v^2``, its
opacity is

    alpha = min(o * response(q), 0.99),     ignored where response(q) < 0.0113 or alpha < 1/255

with ``response(q) = exp(-q / 2)`` for degree 2 (2DGS, Huang et al. 2024) and ``exp(-(4.5 / 81) q^2)`` for
degree 4 (3DGRT's generalised Gaussian, Moenne-Loccoz et al. 2024). Both reach the same value at three
sigma (conventions.md, 6). Nothing else evaluates this formula, except the float64 oracle in
:mod:`tron.tracing.reference`.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import wraps
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from tron.errors import TronError

MIN_RESPONSE = 0.0113
MIN_ALPHA = 1.0 / 255.0
MAX_ALPHA = 0.99
T_MIN = 1e-3
"""Camera rays ignore surfels nearer than this (world units)."""

GEOMETRY_PACKETS = 3
"""A geometry record is 12 floats: centre, opacity | t_u / s_u, radius | t_v / s_v, q_cut."""
RADIUS = 7
"""Place of the radius in a geometry record."""
CUT = 11
"""Place of q_cut, the squared Mahalanobis distance at which a surfel is cut; negative: it counts nowhere."""
FEATURE_PACKETS = 3
"""A feature record is 12 floats: normal, roughness | base color, metallic | radiance of SH degree 0, 0."""
SH_PACKETS = 12
"""An SH record is 48 floats in the order of scenes: (red, green, blue) of each coefficient in turn."""
Function = TypeVar("Function", bound=Callable)


def value_packets(count: int) -> int:
    """Packets of four floats that hold ``count`` values of a surfel."""
    return -(-count // 4)


def cut_radius_squared(opacity: mi.Float, degree: int, least: float = MIN_RESPONSE) -> mi.Float:
    """Largest squared Mahalanobis distance at which a surfel still counts; negative where it never does.

    Args:
        opacity: after the sigmoid; not differentiated through, because visibility is not.
        degree: kernel degree, 2 or 4.
        least: response below which nothing counts, at any opacity.
    """
    if degree not in (2, 4):
        raise TronError(f"kernel degree {degree} is not known", mend="use 2 or 4")
    faintest = MIN_ALPHA / dr.select(opacity > 1e-12, opacity, 1e-12)
    threshold = dr.select(faintest > least, faintest, least)
    log_response = dr.log(threshold)
    q = -2 * log_response if degree == 2 else dr.safe_sqrt(-18 * log_response)
    return dr.select(threshold <= 1, q, -1)


def half_axes(u_axis: mi.Vector3f, v_axis: mi.Vector3f, q_cut: mi.Float) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Conjugate half axes of the ellipse within which a surfel counts, from the axes of its record.

    The record's axes are ``t_u / s_u`` and ``t_v / s_v``, at right angles except for projected splats.
    """
    reach = dr.sqrt(dr.select(q_cut > 0, q_cut, 0))
    u_scale, v_scale = dr.rcp(dr.norm(u_axis)), dr.rcp(dr.norm(v_axis))
    u, v = u_axis * u_scale, v_axis * v_scale  # their product may overflow float32, unit vectors' does not
    normal = dr.cross(u, v)
    reach /= dr.squared_norm(normal)
    return dr.cross(v, normal) * (reach * u_scale), dr.cross(normal, u) * (reach * v_scale)


def response(q: Any, degree: int) -> Any:
    """Response of the kernel at squared Mahalanobis distance ``q`` (Dr.Jit float)."""
    return dr.exp(-0.5 * q) if degree == 2 else dr.exp((-1.0 / 18.0) * q * q)


def log_response_slope(q: Any, degree: int) -> Any:
    """Derivative of ``log(response(q))`` by ``q``."""
    return -0.5 if degree == 2 else (-1.0 / 9.0) * q


@dataclass
class SurfelRecords:
    """Surfels as packed Dr.Jit buffers, in the scene's order, from :func:`tron.tracing.parameters.pack`.

    Attributes:
        geometry: mi.Float, M records of ``4 * GEOMETRY_PACKETS``.
        features: mi.Float, M records of ``4 * FEATURE_PACKETS``.
        harmonics: mi.Float, M records of ``4 * SH_PACKETS``; one unused zero where ``sh_degree`` is 0.
        count: M; 1 where the scene has no surfel: a record that no ray meets.
        degree: kernel degree, 2 or 4.
        sh_degree: highest SH degree that is evaluated.
        values: mi.Float, M records of further quantities to composite, padded to whole packets, or None.
        value_count: number of these quantities.
        pixel: low-pass filter of the camera that the records are for (:func:`intersect`); None: no filter.
    """

    geometry: mi.Float
    features: mi.Float
    harmonics: mi.Float
    count: int
    degree: int
    sh_degree: int
    values: mi.Float | None = None
    value_count: int = 0
    pixel: mi.Vector3f | None = None

    def detached(self) -> SurfelRecords:
        """The same buffers, detached from automatic differentiation."""
        return replace(
            self,
            geometry=dr.detach(self.geometry),
            features=dr.detach(self.features),
            harmonics=dr.detach(self.harmonics),
            values=None if self.values is None else dr.detach(self.values),
        )

    def turned_over(self, which: mi.Bool) -> SurfelRecords:
        """The same disks; those selected by ``which``, M lanes, with front and back exchanged."""
        return replace(
            self,
            geometry=turned_geometry(self.geometry, which),
            features=_negated(self.features, FEATURE_PACKETS, 0, which),
        )


def turned_geometry(geometry: mi.Float, which: mi.Bool) -> mi.Float:
    """Geometry records of the same disks, some with front and back exchanged by negating t_v."""
    return _negated(geometry, GEOMETRY_PACKETS, 2, which)


def _negated(records: mi.Float, packets: int, packet: int, which: mi.Bool) -> mi.Float:
    """Negate the first three floats of one packet in the records of ``which``."""
    index = dr.arange(mi.UInt32, dr.width(records))
    place, record = index % (4 * packets), index // (4 * packets)
    turned = dr.gather(mi.Bool, which, record, record < dr.opaque(mi.UInt32, dr.width(which)))
    turned &= (place >= 4 * packet) & (place < 4 * packet + 3)
    values = dr.select(turned, -records, records)
    dr.eval(values)
    return values


@dataclass
class SurfelHit:
    """One ray against one surfel. All fields are Dr.Jit variables; unread ones are not computed.

    Attributes:
        t: distance along the unit ray to the surfel's plane, world units.
        alpha: opacity at the hit, clipped to 0.99.
        within: the hit lies where the kernel counts (alpha >= 1/255, response >= 0.0113).
        front: the ray meets the side that the normal points to.
        radius: longer radius of the disk within which the surfel counts, world units.
        unclipped: opacity before clipping. response: the kernel's value.
        u_axis, v_axis: t_u / s_u and t_v / s_v. normal: their cross product. facing: normal . direction.
        offset: p - c. u, v: its coordinates in standard deviations. q: u^2 + v^2.
        filtered: the hit of the pixel's filter; None if the records have no filter.
    """

    t: mi.Float
    alpha: mi.Float
    within: mi.Bool
    front: mi.Bool
    radius: mi.Float
    unclipped: mi.Float
    response: mi.Float
    u_axis: mi.Vector3f
    v_axis: mi.Vector3f
    normal: mi.Vector3f
    facing: mi.Float
    offset: mi.Vector3f
    u: mi.Float
    v: mi.Float
    q: mi.Float
    filtered: Filtered | None = None


@dataclass
class Filtered:
    """One ray against a pixel's filter about a surfel's centre.

    Attributes:
        depth: of the centre. slope: distance along the ray to depth 1. Both in the pixel's unit.
        aside: from centre to ray in the image plane, in the filter's standard deviations, world.
        larger: the filter is larger than the disk here.
    """

    depth: mi.Float
    slope: mi.Float
    aside: mi.Vector3f
    larger: mi.Bool


def intersect(
    geometry: mi.Float, index: mi.UInt32, origin: mi.Point3f, direction: mi.Vector3f, degree: int,
    pixel: mi.Vector3f | None = None,
) -> SurfelHit:  # fmt: skip
    """Meet a ray with the surfel ``index`` (formula: module docstring).

    ``pixel`` is the camera's forward axis times the filter's deviation over the focal length. If it is given,
    the larger of the disk's response and that of the filter's Gaussian about the projected centre counts
    (Huang et al. 2024, equation 11); the filter is met from both sides, at the depth of the centre.

    The normal is not stored: ``(t_u / s_u) x (t_v / s_v)`` points the same way and its length cancels in t.
    Reading memory dominates, so a record is three packets and everything else is recomputed.
    An edge-on ray divides zero by zero; the comparisons are then false and the hit does not count.
    """
    base = index * GEOMETRY_PACKETS
    centre = dr.gather(mi.Vector4f, geometry, base)
    axis_u = dr.gather(mi.Vector4f, geometry, base + 1)
    axis_v = dr.gather(mi.Vector4f, geometry, base + 2)
    to_centre = mi.Vector3f(centre[0] - origin.x, centre[1] - origin.y, centre[2] - origin.z)
    u_axis = mi.Vector3f(axis_u[0], axis_u[1], axis_u[2])
    v_axis = mi.Vector3f(axis_v[0], axis_v[1], axis_v[2])
    normal = dr.cross(u_axis, v_axis)
    facing = dr.dot(normal, direction)
    t = dr.dot(normal, to_centre) / facing
    offset = dr.fma(t, direction, -to_centre)
    u, v = dr.dot(offset, u_axis), dr.dot(offset, v_axis)
    q, front, filtered = dr.fma(u, u, v * v), facing < 0.0, None
    if pixel is not None:
        depth, slope = dr.dot(pixel, to_centre), dr.rcp(dr.dot(pixel, direction))
        aside = slope * direction - to_centre / depth
        spread = dr.squared_norm(aside)
        filtered = Filtered(depth, slope, aside, ~((q <= spread) & (t > 0)))
        # The hit of a disk seen exactly edge on is NaN, and so are its derivatives.
        q = dr.select(filtered.larger, spread, q)
        u, v, offset = (dr.select(filtered.larger, 0, each) for each in (u, v, offset))
        facing = dr.select(filtered.larger, -1, facing)
        front, t = mi.Bool(True), depth * slope
    value = response(q, degree)
    unclipped = centre[3] * value
    return SurfelHit(
        t=t,
        # dr.select is a quarter of the cost of dr.minimum on LLVM.
        alpha=dr.select(unclipped < MAX_ALPHA, unclipped, MAX_ALPHA),
        within=q <= axis_v[3],
        front=front,
        radius=axis_u[3],
        unclipped=unclipped,
        response=value,
        u_axis=u_axis,
        v_axis=v_axis,
        normal=normal,
        facing=facing,
        offset=offset,
        u=u,
        v=v,
        q=q,
        filtered=filtered,
    )


def recorded(function: Function) -> Function:
    """Freeze ``function``: record it once for each kind of arguments; ``__wrapped__`` is Dr.Jit's function.

    Garbage collection is off while recording: freeing a Mitsuba object then aborts the process, and Python's
    collector may free an unused integrator or scene at any allocation.

    Among Python numbers in the arguments, Dr.Jit 1.5.0 does not tell repeated values apart (it takes 4, 3, 4
    for 4, 3, 3). So the numbers are part of the key here.
    """
    frozen = dr.freeze(function, state_fn=lambda *arguments: _kind(arguments), limit=64, warn_after=1000)

    @wraps(frozen)
    def call(*arguments: object) -> object:
        collects = gc.isenabled()
        gc.disable()
        try:
            return frozen(*arguments)
        finally:
            if collects:
                gc.enable()

    return call  # pyright: ignore[reportReturnType]


def _kind(value: object) -> str:
    """All arguments that are not arrays, in order."""
    if is_dataclass(value):
        return _kind([getattr(value, field.name) for field in fields(value)])
    if isinstance(value, (list, tuple)):
        return f"({','.join(map(_kind, value))})"
    return repr(value) if value is None or isinstance(value, (bool, int, float, str)) else ""
