"""The kernel of a 2D Gaussian surfel: where a ray meets its disk and how opaque it is there.

A surfel is a flat Gaussian in the plane of its tangents ``t_u, t_v``. With ``p`` the point where the ray
meets that plane, ``u = (p - c) . t_u / s_u``, ``v = (p - c) . t_v / s_v`` and ``q = u^2 + v^2``, its
opacity is

    alpha = min(o * response(q), 0.99),     ignored where response(q) < 0.0113 or alpha < 1/255

with ``response(q) = exp(-q / 2)`` for degree 2 (2DGS, Huang et al. 2024) and ``exp(-(4.5 / 81) q^2)`` for
degree 4 (3DGRT's generalised Gaussian, Moenne-Loccoz et al. 2024). Both reach the same value at three
sigma. Nothing else evaluates this formula, except the float64 oracle in :mod:`tron.tracing.reference`.
"""

# pyright: reportOperatorIssue=false, reportArgumentType=false
# (Mitsuba's type stubs know neither arithmetic between its own array types nor its aliases of Dr.Jit's.)

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.errors import TronError
from tron.gaussians.harmonics import dc_to_rgb

if TYPE_CHECKING:
    from tron.gaussians.scene import GaussianScene

MIN_RESPONSE = 0.0113
MIN_ALPHA = 1.0 / 255.0
MAX_ALPHA = 0.99
T_MIN = 1e-3
"""Camera rays ignore surfels nearer than this (world units)."""

GEOMETRY_PACKETS = 3
"""A geometry record is 12 floats: centre, opacity | t_u / s_u, radius | t_v / s_v, q_cut."""
FEATURE_PACKETS = 3
"""A feature record is 12 floats: normal, roughness | base color, metallic | radiance of SH degree 0, 0."""
SH_PACKETS = 12
"""An SH record is 48 floats: 16 coefficients of red, of green, of blue."""


def cut_radius_squared(opacities: np.ndarray, degree: int) -> np.ndarray:
    """Largest squared Mahalanobis distance at which a surfel still counts; negative where it never does.

    Args:
        opacities: (M,) float, after the sigmoid.
        degree: kernel degree, 2 or 4.

    Returns:
        (M,) float64.
    """
    threshold = np.maximum(MIN_RESPONSE, MIN_ALPHA / np.maximum(opacities.astype(np.float64), 1e-12))
    log_response = np.log(threshold)
    if degree == 2:
        q = -2.0 * log_response
    elif degree == 4:
        q = np.sqrt(np.maximum(-18.0 * log_response, 0.0))
    else:
        raise TronError(f"kernel degree {degree} is not known", mend="use 2 or 4")
    return np.where(threshold <= 1.0, q, -1.0)


def response(q: Any, degree: int) -> Any:
    """Response of the kernel at squared Mahalanobis distance ``q`` (Dr.Jit float)."""
    return dr.exp(-0.5 * q) if degree == 2 else dr.exp((-1.0 / 18.0) * q * q)


@dataclass
class SurfelRecords:
    """A scene's surfels as packed Dr.Jit buffers, in the scene's order.

    Attributes:
        geometry: mi.Float, M records of ``4 * GEOMETRY_PACKETS``.
        features: mi.Float, M records of ``4 * FEATURE_PACKETS``.
        harmonics: mi.Float, M records of ``4 * SH_PACKETS``; one unused zero where ``sh_degree`` is 0.
        count: M.
        degree: kernel degree, 2 or 4.
        sh_degree: highest SH degree with a coefficient that is not zero.
    """

    geometry: mi.Float
    features: mi.Float
    harmonics: mi.Float
    count: int
    degree: int
    sh_degree: int


def pack_geometry(scene: GaussianScene) -> np.ndarray:
    """(M, 12) float32 geometry records of a scene (layout: :data:`GEOMETRY_PACKETS`)."""
    tangent_u, tangent_v = scene.tangents()
    scales, opacities = scene.scales(), scene.opacities()
    q_cut = cut_radius_squared(opacities, scene.kernel_degree)
    records = np.empty((len(scene), 12), np.float32)
    records[:, 0:3] = scene.means
    records[:, 3] = opacities
    records[:, 4:7] = tangent_u / scales[:, :1]
    records[:, 7] = scales.max(1) * np.sqrt(np.maximum(q_cut, 0.0))
    records[:, 8:11] = tangent_v / scales[:, 1:]
    records[:, 11] = q_cut
    return records


def pack_features(scene: GaussianScene) -> np.ndarray:
    """(M, 12) float32 feature records of a scene (layout: :data:`FEATURE_PACKETS`)."""
    records = np.zeros((len(scene), 12), np.float32)
    records[:, 0:3] = scene.normals()
    records[:, 3] = scene.roughness
    records[:, 4:7] = scene.base_color
    records[:, 7] = scene.metallic
    records[:, 8:11] = np.maximum(dc_to_rgb(scene.sh[:, 0]), 0.0)
    return records


def sh_degree(scene: GaussianScene) -> int:
    """Highest spherical-harmonics degree of the scene with a coefficient that is not zero."""
    used = np.any(scene.sh != 0.0, axis=(0, 2)) if len(scene) else np.zeros(16, bool)
    return math.isqrt(int(np.flatnonzero(used).max())) if used.any() else 0


def upload(scene: GaussianScene, geometry: np.ndarray) -> SurfelRecords:
    """Upload a scene's surfels and their ``pack_geometry`` records, in the scene's own order."""
    degree = sh_degree(scene)
    # Dr.Jit refuses empty arrays as loop state: an unused scalar stands in.
    harmonics = scene.sh.transpose(0, 2, 1).ravel() if degree > 0 else np.zeros(1, np.float32)
    records = SurfelRecords(
        geometry=mi.Float(geometry.ravel()),
        features=mi.Float(pack_features(scene).ravel()),
        harmonics=mi.Float(harmonics),
        count=len(scene),
        degree=scene.kernel_degree,
        sh_degree=degree,
    )
    dr.eval(records.geometry, records.features, records.harmonics)
    return records


@dataclass
class SurfelHit:
    """One ray against one surfel. All fields are Dr.Jit variables.

    Attributes:
        t: distance along the unit ray to the surfel's plane, world units.
        alpha: opacity at the hit, clipped to 0.99.
        within: the hit lies where the kernel counts (alpha >= 1/255, response >= 0.0113).
        front: the ray meets the side that the normal points to.
        near: lower bound of the distance from the ray's origin to any counted point of the surfel.
    """

    t: mi.Float
    alpha: mi.Float
    within: mi.Bool
    front: mi.Bool
    near: mi.Float


def intersect(
    geometry: mi.Float, index: mi.UInt32, origin: mi.Point3f, direction: mi.Vector3f, degree: int
) -> SurfelHit:
    """Meet a ray with the surfel ``index`` (formula: module docstring).

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
    q = dr.fma(u, u, v * v)
    raw = centre[3] * response(q, degree)
    # dr.select is a quarter of the cost of dr.minimum on LLVM (measured in tracer.md).
    alpha = dr.select(raw < MAX_ALPHA, raw, MAX_ALPHA)
    return SurfelHit(
        t=t, alpha=alpha, within=q <= axis_v[3], front=facing < 0.0, near=dr.norm(to_centre) - axis_u[3]
    )
