"""Reflectance of a material: the share of uniform light that its diffuse part and its lobe reflect.

                "conserving", the data engine's                         "lambert", the paper's
    specular    (1 - metallic) G g(F_glass) + metallic S g(F_base)      F0 A + B
    diffuse     base (1 - metallic) (1 - G g(F_glass))                  base (1 - metallic)

F0 is 0.04 (1 - metallic) + metallic base, S = base A + B; A, B, G and E come from :mod:`tron.brdf.table`.
A lobe of single reflections loses the light that meets a second facet: white metal of roughness 1 would
reflect less than half of the light. The lost light is added back in the lobe's own shape,

    g(F) = 1 + (1 - e) / e  F E / (1 - F (1 - E))       e = A + B at the angle of view, F the mean Fresnel

(Turquin 2019, "Practical multiple scattering compensation for microfacet models"; F's part by Kulla and Conty
2017), as in Cycles. The diffuse part gets the light that the lobe leaves, so white reflects all light at
every roughness and angle. Under a lobe it is not reciprocal, because it depends on the angle of view alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.brdf.table import GLASS_INDEX, BrdfTable
from tron.estimation import Brdf

DIELECTRIC_F0 = 0.04
MOST_ALBEDO = 0.99
"""Largest albedo of a bounce, so that light dies out."""
MOST_FRESNEL = 1.001
"""Largest F, for float images with base colors above 1; it exceeds 1, so that white keeps its derivative."""
LEAST_F0 = 1e-3
"""Least F0 for a lobe's mean direction, so that black metal has one too."""
LEAST_ALBEDO = 1e-3
"""Least value of the table's e, by which is divided: a rough lobe has none at grazing angles."""


Array = TypeVar("Array")


class Material(Protocol):
    """Linear base color, roughness and metallic, in [0, 1]; any number of lanes."""

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


@dataclass
class Layers:
    """The layers of a material towards a view, energy kept.

    Attributes:
        body: mi.Color3f, the diffuse part's albedo.
        glass: factor g on the dielectric's lobe.
        metal: mi.Color3f, factor g on the metal's lobe.
        specular: mi.Color3f, albedo of both lobes, weighted by metallic.
    """

    body: mi.Color3f
    glass: mi.Float
    metal: mi.Color3f
    specular: mi.Color3f

    @classmethod
    def of(cls, material: Material, table: BrdfTable, cosine: mi.Float | None = None) -> Layers:
        """Arguments as in :func:`reflectance`."""
        scale, bias, glass, whole = table(material.roughness, cosine)
        single = dr.maximum(scale + bias, LEAST_ALBEDO)
        of_glass = compensation(mi.Float(glass_fresnel()), single, whole)
        of_metal = compensation(dr.minimum(mean_fresnel(material.base_color), MOST_FRESNEL), single, whole)
        lobe, metallic = glass * of_glass, material.metallic
        return cls(
            material.base_color * (1 - metallic) * (1 - lobe),
            of_glass,
            of_metal,
            (1 - metallic) * lobe + metallic * (material.base_color * scale + bias) * of_metal,
        )


def compensation(fresnel: Array, single: Any, whole: Any) -> Array:
    """Factor g on a lobe that adds multiple scattering between facets; NumPy and Dr.Jit alike.

    Args:
        fresnel: F, its mean over cosine-distributed directions, in [0, 1].
        single: e, the perfect mirror's albedo at the angle of view, at least ``LEAST_ALBEDO``.
        whole: E, its mean over angles.
    """
    return 1 + (1 - single) / single * (fresnel * whole) / (1 - fresnel * (1 - whole))


def mean_fresnel(base_color: Array) -> Array:
    """F of a metal: Schlick's, averaged over cosine-distributed directions; NumPy and Dr.Jit alike."""
    return base_color + (1 - base_color) * (1 / 21)


@cache
def glass_fresnel() -> float:
    """Mean of Fresnel's equations for glass over cosine-distributed directions: 0.0918."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    cosine = (nodes + 1) / 2
    inside = np.sqrt(1 - (1 - cosine**2) / GLASS_INDEX**2)
    across = (cosine - GLASS_INDEX * inside) / (cosine + GLASS_INDEX * inside)
    along = (inside - GLASS_INDEX * cosine) / (inside + GLASS_INDEX * cosine)
    return float((weights * cosine * (across**2 + along**2) / 2).sum())


def reflectance(
    material: Material, table: BrdfTable, cosine: mi.Float | None = None, brdf: Brdf = "conserving"
) -> Reflectance:
    """Reflectance of a material, differentiable in it.

    Args:
        material: such as a :class:`tron.tracing.Surface`.
        table: of the active variant.
        cosine: n.v; None: the cosine-weighted mean over all views, as for bounced light.
        brdf: the model.
    """
    if brdf == "lambert":
        scale, bias, _, _ = table(material.roughness, cosine)
        return Reflectance(material.base_color * (1 - material.metallic), _f0(material) * scale + bias)
    layers = Layers.of(material, table, cosine)
    return Reflectance(layers.body, layers.specular)


def fresnel(
    material: Material, cosine: mi.Float, brdf: Brdf = "conserving", layers: Layers | None = None
) -> mi.Color3f:
    """Share that one facet mirrors at ``cosine`` to the half vector; its mean over a lobe is in ``table``.

    With ``layers``, each lobe's share is multiplied by its factor g.
    """
    weight = (1 - dr.clip(cosine, 0, 1)) ** 5
    if brdf == "lambert":
        return dr.lerp(_f0(material), 1, weight)
    glass, metal = mi.fresnel(cosine, GLASS_INDEX)[0], dr.lerp(material.base_color, 1, weight)
    if layers is not None:
        glass, metal = layers.glass * glass, layers.metal * metal
    return (1 - material.metallic) * glass + material.metallic * metal


def lobe_parts(
    material: Material, table: BrdfTable, normal: mi.Vector3f, to_camera: mi.Vector3f
) -> list[tuple[mi.Float, mi.Vector3f]]:
    """Parts of a lobe: for each its share of the light and its mean direction, world. Shares sum to 1.

    The wider a part, the shorter its mean direction (:mod:`tron.brdf.table`).

    Args:
        material, table: as in :func:`reflectance`.
        normal, to_camera: unit, world.
    """
    normal, to_camera = mi.Vector3f(normal), mi.Vector3f(to_camera)
    cosine = dr.dot(normal, to_camera)
    f0 = dr.lerp(DIELECTRIC_F0, mi.luminance(material.base_color), material.metallic)
    f0 = dr.maximum(f0, LEAST_F0)
    along, (share, apart, longer) = table.lobe(material.roughness, cosine, f0)
    # A normal seen from behind also mirrors away from the surface.
    mirrored = (cosine + dr.abs(cosine)) * normal - to_camera
    mean = along.x * mirrored + along.y * normal
    length2 = dr.squared_norm(mean)
    spread = dr.maximum(1 - length2, 1e-12)
    lean = normal - dr.dot(normal, mean) / length2 * mean
    off = apart * dr.sqrt(spread) * lean + longer * spread * dr.rsqrt(length2) * mean
    return [(share, mean + off), (1 - share, mean - share / (1 - share) * off)]


def _f0(material: Material) -> mi.Color3f:
    return DIELECTRIC_F0 * (1 - material.metallic) + material.metallic * material.base_color


def bounce_albedo(material: Material, table: BrdfTable, brdf: Brdf = "conserving") -> mi.Color3f:
    """Share of uniform light that a surface reflects, its lobe included, by channel.

    At most ``MOST_ALBEDO``; differentiable. Arguments as in :func:`reflectance`.
    """
    share = reflectance(material, table, brdf=brdf)
    return dr.minimum(share.diffuse + share.specular, MOST_ALBEDO)
