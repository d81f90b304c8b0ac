"""Reflectances of a surface's material: the metallic workflow (Burley 2012, Karis 2013).

    diffuse    k_d = base (1 - m)
    specular   F_0 = 0.04 (1 - m) + base m,    at normal incidence

Both linear, by base color and metallic m; the specular lobe's albedo towards a view at cosine c is
F_0 A(c, roughness) + B(c, roughness) of :func:`tron.shading.split_sum.brdf_table`.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.aligned import aligned
from tron.shading.split_sum import TABLE_SIZE, brdf_table

if TYPE_CHECKING:
    from tron.tracing import Surface

DIELECTRIC_F0 = 0.04
MOST_ALBEDO = 0.99
"""Largest albedo of a bounce: light dies out."""


def diffuse_albedo(surface: Surface) -> mi.Color3f:
    """Albedo k_d of the diffuse part, linear."""
    return surface.base_color * (1 - surface.metallic)


def specular_f0(surface: Surface) -> mi.Color3f:
    """Specular reflectance F_0 at normal incidence, linear."""
    return DIELECTRIC_F0 * (1 - surface.metallic) + surface.metallic * surface.base_color


def bounce_albedo(surface: Surface) -> mi.Color3f:
    """Share of evenly arriving light that leaves a surface again, its specular lobe included, by channel.

        k_d + F_0 A + B,    with A and B averaged over directions by their cosine

    at most ``MOST_ALBEDO``, because k_d and the lobe are not coupled; differentiable.
    """
    x = dr.clip(surface.roughness * TABLE_SIZE - 0.5, 0, TABLE_SIZE - 1)
    row = mi.UInt32(x)
    row = dr.select(row < TABLE_SIZE - 1, row, TABLE_SIZE - 2)
    table = mi.Float(aligned(_mean_table().ravel()))
    low, high = (dr.gather(mi.Vector2f, table, row + k) for k in (0, 1))
    scale, bias = dr.lerp(low, high, x - mi.Float(row))
    albedo = diffuse_albedo(surface) + specular_f0(surface) * scale + bias
    return dr.select(albedo < MOST_ALBEDO, albedo, MOST_ALBEDO)


@cache
def _mean_table() -> np.ndarray:
    """(roughness, 2) float32: ``brdf_table`` averaged over n.v with the cosine's weight."""
    cosine = (np.arange(TABLE_SIZE) + 0.5) / TABLE_SIZE
    return np.einsum("rck,c->rk", brdf_table(), cosine / cosine.sum()).astype(np.float32)
