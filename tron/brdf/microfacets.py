"""The GGX microfacet distribution: visible normals, masking and shadowing; in the local frame, n is z.

    D(h) = a^2 / (pi (h_z^2 (a^2 - 1) + 1)^2)               a = roughness^2
    G_1(v) = 2 v_z / (v_z + s(v))                            s(v) = sqrt(a^2 + (1 - a^2) v_z^2)
    G_2(v, l) = 2 v_z l_z / (l_z s(v) + v_z s(l))            heights correlated

(Walter et al. 2007; Heitz 2014, "Understanding the masking-shadowing function", eq. 99), as in glTF and
Cycles; Mitsuba's materials multiply G_1(v) and G_1(l), which counts the masking of equally high facets twice.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def visible_normal(view: mi.Vector3f, alpha: mi.Float, u: mi.Point2f) -> mi.Vector3f:
    """Half vector sampled from the GGX normals visible to ``view``, both unit and local (Heitz 2018)."""
    stretched = dr.normalize(mi.Vector3f(alpha * view.x, alpha * view.y, view.z))
    length2 = dr.square(stretched.x) + dr.square(stretched.y)
    aslant = length2 > 1e-12
    inverse = dr.rsqrt(dr.select(aslant, length2, 1))
    across = dr.select(
        aslant, mi.Vector3f(-stretched.y * inverse, stretched.x * inverse, 0), mi.Vector3f(1, 0, 0)
    )
    along = dr.cross(stretched, across)
    radius = dr.sqrt(u.x)
    sin, cos = dr.sincos(u.y * float(2 * dr.pi))
    x, y, squeeze = radius * cos, radius * sin, 0.5 * (1 + stretched.z)
    y = (1 - squeeze) * dr.safe_sqrt(1 - x * x) + squeeze * y
    normal = x * across + y * along + dr.safe_sqrt(1 - x * x - y * y) * stretched
    return dr.normalize(mi.Vector3f(alpha * normal.x, alpha * normal.y, dr.maximum(normal.z, 1e-6)))


def seen_density(view: mi.Float, half: mi.Vector3f, alpha: mi.Float) -> mi.Float:
    """Solid-angle density of ``view`` mirrored at a :func:`visible_normal`, D G_1(v) / (4 v_z).

    Args:
        view: its cosine to the normal, above 0.
        half: half vector, unit, local.
        alpha: of the distribution.
    """
    return distribution(half, alpha) / (2 * (view + _slope(view, alpha)))


def distribution(half: mi.Vector3f, alpha: mi.Float) -> mi.Float:
    """D at a half vector."""
    alpha2 = dr.square(alpha)
    # By the sine: 1 minus the squared cosine loses all digits where a lobe is narrow.
    spread = alpha2 * dr.square(half.z) + dr.square(half.x) + dr.square(half.y)
    return alpha2 / (dr.pi * dr.square(spread))


def unhidden(view: mi.Float, out: mi.Float, alpha: mi.Float) -> mi.Float:
    """G_2 / G_1(v): share of the light towards ``out`` not blocked by other facets; cosines, above 0."""
    at_view, at_out = _slope(view, alpha), _slope(out, alpha)
    return out * (view + at_view) / (out * at_view + view * at_out)


def _slope(cosine: mi.Float, alpha: mi.Float) -> mi.Float:
    alpha2 = dr.square(alpha)
    return dr.sqrt(alpha2 + (1 - alpha2) * dr.square(cosine))
