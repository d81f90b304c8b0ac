"""Reflectance of a material: the share of uniform light that its diffuse part and its lobe send on.

                "conserving", the data engine's                         "lambert", the paper's
    specular    (1 - metallic) G g(F_glass) + metallic S g(F_base)      F0 A + B
    diffuse     base (1 - metallic) (1 - G g(F_glass))                  base (1 - metallic)

F0 is 0.04 (1 - metallic) + metallic base, S = base A + B; A, B, G and E are those of :mod:`tron.brdf.table`.
A lobe of single reflections loses the light that meets a second facet: white metal of roughness 1 would send
out less than half of what arrives. That light is given back in the lobe's own shape,

    g(F) = 1 + (1 - e) / e  F E / (1 - F (1 - E))       e = A + B at the angle of view, F the mean Fresnel

(Turquin 2019, "Practical multiple scattering compensation for microfacet models"; F's part by Kulla and Conty
2017), as Cycles has it. Diffuse gets what the lobe leaves. So white sends out all that arrives, at every
roughness and angle. Below a lobe the diffuse part is not reciprocal: it knows the angle of view alone.
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
"""Largest albedo of a bounce: light dies out."""
MOST_FRESNEL = 1.001
"""Of base colors beyond 1, which a float image may hold: a little above 1, where white has its derivative."""
LEAST_F0 = 1e-3
"""Of a lobe whose mean direction is asked for: black metal has one too."""
LEAST_ALBEDO = 1e-3
"""Of the table's e, before it is divided by: at grazing angles a rough lobe has none."""


Array = TypeVar("Array")


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


@dataclass
class Layers:
    """The layers of a material towards a view, energy kept.

    Attributes:
        body: mi.Color3f, the diffuse part's albedo.
        glass: factor g on the dielectric's lobe.
        metal: mi.Color3f, that on the metal's.
        specular: mi.Color3f, albedo of both lobes, by their shares.
    """

    body: mi.Color3f
    glass: mi.Float
    metal: mi.Color3f
    specular: mi.Color3f

    @classmethod
    def of(cls, material: Material, table: BrdfTable, cosine: mi.Float | None = None) -> Layers:
        """Arguments as of :func:`reflectance`."""
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
    """Factor g on a lobe that gives back the light which meets further facets; NumPy and Dr.Jit alike.

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
        cosine: n.v; None: the mean over all directions of view, by the cosine, as of light that bounces.
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

    With ``layers`` each lobe's has its factor g.
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
    """Parts of a lobe: share of its light, and the mean of the directions, world, that it comes from.

    A mean is the shorter the wider its part (:mod:`tron.brdf.table`). Shares sum to 1.

    Args:
        material, table: as of :func:`reflectance`.
        normal, to_camera: unit, world.
    """
    normal, to_camera = mi.Vector3f(normal), mi.Vector3f(to_camera)
    cosine = dr.dot(normal, to_camera)
    f0 = dr.lerp(DIELECTRIC_F0, mi.luminance(material.base_color), material.metallic)
    f0 = dr.maximum(f0, LEAST_F0)
    along, (share, apart, longer) = table.lobe(material.roughness, cosine, f0)
    # A normal that is seen from behind mirrors away from the surface too.
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
    """Share of evenly arriving light that leaves a surface again, its lobe included, by channel.

    At most ``MOST_ALBEDO``; differentiable. Arguments as of :func:`reflectance`.
    """
    share = reflectance(material, table, brdf=brdf)
    return dr.minimum(share.diffuse + share.specular, MOST_ALBEDO)
