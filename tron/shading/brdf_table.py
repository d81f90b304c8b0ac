"""Shares of light that a material reflects, by roughness and n.v, integrated over all directions.

    A, B    of F0 A + B, the albedo of a GGX mirror with Schlick's Fresnel: the split sum (Karis 2013)
    E       albedo of the same mirror on glass of index 1.5, whose F0 is 0.04, with Fresnel's own equations
    D       factor on Lambert's albedo of the diffuse part of Mitsuba's ``principled`` (Burley 2012, 2015)

Burley's diffuse part is base / pi (f + r), with Schlick weights F_l = (1 - n.l)^5, F_v alike, and h between
l and v:

    f = (1 - F_l / 2) (1 - F_v / 2)            less where the surface mirrors
    r = R (F_l + F_v + F_l F_v (R - 1))        retro-reflection, R = 2 roughness (h.l)^2 = roughness (1 + l.v)

so D = mean of f + r over cosine-distributed l. It is 0.5 to 1.55: below 1 where smooth surfaces are seen at
grazing angles, above where rough ones are; its mean over v is 0.95 to 1.065. E is above 0.04 A + B by up to
0.02: Schlick's Fresnel is 0.07 at 60 degrees, where glass mirrors 0.09.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.runtime import aligned

TABLE_SIZE = 256
TABLE_SAMPLES = 32
"""Quadrature points along each of the two dimensions of the visible normals."""
GLASS_INDEX = 1.5
DIFFUSE_NODES = 5
"""Gauss-Legendre nodes of the diffuse part, which is a polynomial of degree 8 in n.l: exact."""


@cache
def brdf_table() -> np.ndarray:
    """(roughness, n.v, 4) float32: A, B, D and E. Computed once a process.

    Rows and columns are centred: entry (i, j) is roughness (i + 1/2) / 256 and n.v = (j + 1/2) / 256. Smith's
    masking in its separable form, as Mitsuba's microfacet materials have it. By midpoint quadrature over the
    visible normals (Heitz 2018, "Sampling the GGX Distribution of Visible Normals").
    """
    lane = dr.arange(mi.UInt32, TABLE_SIZE * TABLE_SIZE)
    cosine = (mi.Float(lane % TABLE_SIZE) + 0.5) / TABLE_SIZE
    roughness = (mi.Float(lane // TABLE_SIZE) + 0.5) / TABLE_SIZE
    lobes = _directional_albedo(cosine, dr.square(roughness))
    scale, bias, glass = (np.array(lobe).reshape(TABLE_SIZE, TABLE_SIZE) for lobe in lobes)
    return np.stack([scale, bias, _diffuse_factor(), glass], -1)


@dr.syntax
def _directional_albedo(cosine: mi.Float, alpha: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
    view = mi.Vector3f(dr.safe_sqrt(1 - cosine * cosine), 0, cosine)
    # Heitz: stretch the view, sample the projected half disk, map back.
    stretched = dr.normalize(mi.Vector3f(alpha * view.x, 0, view.z))
    across = mi.Vector3f(0, 1, 0)
    along = dr.cross(stretched, across)
    squeeze = 0.5 * (1 + stretched.z)
    scale, bias, glass, total = mi.Float(0), mi.Float(0), mi.Float(0), mi.Float(0)
    i = mi.UInt32(0)
    while i < TABLE_SAMPLES * TABLE_SAMPLES:
        # The rim of the disk is the lobe's long tail: points crowd there, by radius^2 = 1 - x^3.
        x = (mi.Float(i % TABLE_SAMPLES) + 0.5) / TABLE_SAMPLES
        radius, share = dr.sqrt(1 - x * x * x), 3 * x * x
        # Mirror symmetry about the plane of incidence: half a turn is enough.
        angle = (mi.Float(i // TABLE_SAMPLES) + 0.5) * float(np.pi / TABLE_SAMPLES)
        sin, cos = dr.sincos(angle - float(np.pi / 2))
        t1, t2 = radius * cos, radius * sin
        t2 = (1 - squeeze) * dr.safe_sqrt(1 - t1 * t1) + squeeze * t2
        t3 = dr.safe_sqrt(1 - t1 * t1 - t2 * t2)
        h = t1 * across + t2 * along + t3 * stretched
        h = dr.normalize(mi.Vector3f(alpha * h.x, alpha * h.y, dr.maximum(h.z, 1e-7)))
        facing = dr.dot(view, h)
        cosine_out = 2 * facing * h.z - view.z
        tangent2 = alpha * alpha * (1 - cosine_out * cosine_out)
        masking = 2 * cosine_out / (cosine_out + dr.safe_sqrt(tangent2 + cosine_out * cosine_out))
        masking = dr.select((cosine_out > 0) & (facing > 0), masking * share, 0)
        fresnel = (1 - facing) ** 5
        scale += masking * (1 - fresnel)
        bias += masking * fresnel
        glass += masking * mi.fresnel(facing, GLASS_INDEX)[0]
        total += share
        i += 1
    return scale / total, bias / total, glass / total


def _diffuse_factor() -> np.ndarray:
    """D, (roughness, n.v) float32."""
    nodes, weights = np.polynomial.legendre.leggauss(DIFFUSE_NODES)
    light = (nodes + 1) / 2
    weights = weights * light  # 2 n.l d(n.l), on half the interval
    centres = (np.arange(TABLE_SIZE) + 0.5) / TABLE_SIZE
    view, roughness = centres[None, :, None], centres[:, None, None]
    towards, away = (1 - light) ** 5, (1 - view) ** 5
    # The azimuth between light and view in closed form: means of R and of R^2.
    along, across = light * view, (1 - light**2) * (1 - view**2)
    once = roughness * (1 + along)
    twice = roughness**2 * ((1 + along) ** 2 + across / 2)
    factor = (1 - towards / 2) * (1 - away / 2)
    factor = factor + (towards + away - towards * away) * once + towards * away * twice
    return (factor * weights).sum(-1).astype(np.float32)


@dataclass
class BrdfTable:
    """:func:`brdf_table` on the device.

    Attributes:
        texels: A, B, D and E, row-major.
        means: the same of each roughness, averaged over cosine-distributed n.v.
    """

    texels: mi.Float
    means: mi.Float

    @classmethod
    def load(cls) -> BrdfTable:
        """The table for the active variant."""
        table = brdf_table()
        cosine = (np.arange(TABLE_SIZE) + 0.5) / TABLE_SIZE
        means = np.average(table, axis=1, weights=cosine).astype(np.float32)
        return cls(*(mi.Float(aligned(values.ravel())) for values in (table, means)))

    def __call__(self, roughness: mi.Float, cosine: mi.Float | None = None) -> mi.Vector4f:
        """A, B, D and E, linear between entries; differentiable.

        Args:
            roughness: in [0, 1].
            cosine: n.v; None: the mean over cosine-distributed directions.
        """
        row, fy = _between(roughness)
        if cosine is None:
            upper, lower = (dr.gather(mi.Vector4f, self.means, row + i) for i in (0, 1))
        else:
            column, fx = _between(cosine)
            first = row * TABLE_SIZE + column

            def texel(index: mi.UInt32) -> mi.Vector4f:
                return dr.gather(mi.Vector4f, self.texels, index)

            upper = dr.lerp(texel(first), texel(first + 1), fx)
            lower = dr.lerp(texel(first + TABLE_SIZE), texel(first + TABLE_SIZE + 1), fx)
        return dr.lerp(upper, lower, fy)


def _between(x: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """The entry below ``x`` in [0, 1], and how far beyond it ``x`` is; ends are held."""
    x = dr.clip(x * TABLE_SIZE - 0.5, 0, TABLE_SIZE - 1)
    entry = dr.minimum(mi.UInt32(x), TABLE_SIZE - 2)
    return entry, x - mi.Float(entry)
