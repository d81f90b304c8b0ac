"""Reflectance of a material: the share of uniform light that its diffuse part and its lobe send on.

                "principled", the data engine's                     "lambert", the paper's
    specular    (1 - metallic) E + metallic (base A + B)            F0 A + B
    diffuse     min(base (1 - metallic) D, 1 - specular)            base (1 - metallic)

F0 is 0.04 (1 - metallic) + metallic base; A, B, D and E are those of :mod:`tron.shading.brdf_table`. Burley's
diffuse part knows nothing of the lobe above it: a white dielectric in a white furnace would shine at 1.02 to
1.09 where it is faced, and at up to 1.6 at grazing angles. The minimum keeps every surface at what arrives;
base colors below 0.8 meet it beyond 70 degrees only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from tron.estimation import Diffuse
from tron.shading.brdf_table import GLASS_INDEX, BrdfTable
from tron.shading.burley import burley_factor

DIELECTRIC_F0 = 0.04
MOST_ALBEDO = 0.99
"""Largest albedo of a bounce: light dies out."""


class Material(Protocol):
    """Base color, linear, roughness and metallic, in [0, 1]; of any number of lanes."""

    base_color: mi.Color3f
    roughness: mi.Float
    metallic: mi.Float


@dataclass
class Reflectance:
    """Shares of the light, by channel.

    Attributes:
        diffuse: factor on irradiance / pi.
        specular: factor on the lobe's mean radiance.
    """

    diffuse: mi.Color3f
    specular: mi.Color3f


def reflectance(
    material: Material,
    table: BrdfTable,
    cosine: mi.Float | None = None,
    diffuse: Diffuse = "principled",
    terms: mi.Vector3f | None = None,
) -> Reflectance:
    """Reflectance of a material, differentiable in it.

    Args:
        material: such as a :class:`tron.tracing.Surface`.
        table: of the active variant.
        cosine: n.v; None: the mean over all directions of view, by the cosine, as of light that bounces.
        diffuse: the model.
        terms: of the light, :mod:`tron.shading.burley`; None: of even light.
    """
    scale, bias, factor, glass = table(material.roughness, cosine)
    body = material.base_color * (1 - material.metallic)
    if diffuse == "lambert":
        return Reflectance(body, _f0(material) * scale + bias)
    specular = _blend(material, glass, material.base_color * scale + bias)
    share = dr.minimum(body * factor, 1 - specular)
    if terms is not None:  # of one direction it is no albedo, and may be more than what is left
        share *= burley_factor(terms, material.roughness, factor) / factor
    return Reflectance(share, specular)


def fresnel(material: Material, cosine: mi.Float, diffuse: Diffuse = "principled") -> mi.Color3f:
    """Share that is mirrored at ``cosine`` to the half vector; its mean over a lobe is in ``reflectance``."""
    weight = (1 - dr.clip(cosine, 0, 1)) ** 5
    if diffuse == "lambert":
        return dr.lerp(_f0(material), 1, weight)
    return _blend(material, mi.fresnel(cosine, GLASS_INDEX)[0], dr.lerp(material.base_color, 1, weight))


def _f0(material: Material) -> mi.Color3f:
    return DIELECTRIC_F0 * (1 - material.metallic) + material.metallic * material.base_color


def _blend(material: Material, glass: mi.Float, metal: mi.Color3f) -> mi.Color3f:
    return (1 - material.metallic) * glass + material.metallic * metal


def bounce_albedo(material: Material, table: BrdfTable, diffuse: Diffuse = "principled") -> mi.Color3f:
    """Share of evenly arriving light that leaves a surface again, its lobe included, by channel.

    At most ``MOST_ALBEDO``; differentiable. Arguments as of :func:`reflectance`.
    """
    share = reflectance(material, table, diffuse=diffuse)
    return dr.minimum(share.diffuse + share.specular, MOST_ALBEDO)
