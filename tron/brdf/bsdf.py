"""The material as a Mitsuba BSDF, ``metallicroughness``, with which ground truth is path-traced.

    f = body / pi + D(h) G_2(v, l) / (4 n.v n.l) F
    F = (1 - metallic) g_glass F_glass(v.h) + metallic g_metal F_metal(v.h)

with :mod:`tron.brdf.microfacets`, Schlick's Fresnel of base color for metal and Fresnel's own equations for
the dielectric of index 1.5; body and the factors g come from :class:`tron.brdf.reflectance.Layers`.
Mitsuba's own ``principled`` would lose up to two thirds of the light on rough metal.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false
from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from tron.brdf.microfacets import seen_density, unhidden, visible_normal
from tron.brdf.reflectance import Layers, Material, fresnel
from tron.brdf.table import BrdfTable

NAME = "metallicroughness"
INPUTS = ("base_color", "roughness", "metallic")
LEAST_ALPHA = 1e-3
"""Least alpha of the distribution, as in ``principled``: narrower lobes exceed float32."""
_LEAST_SHARE = 0.1
"""Least share of the samples for either part, if both are present."""


def metallic_roughness(base_color: Any, roughness: Any, metallic: Any) -> mi.BSDF:
    """The material, one-sided; wrap it in ``twosided`` for open shells.

    Args:
        base_color: linear RGB in [0, 1]: a number, a texture or its dictionary.
        roughness, metallic: in [0, 1]: a number, a texture or its dictionary.
    """
    register_bsdf()
    properties = {"base_color": base_color, "roughness": roughness, "metallic": metallic}
    if isinstance(base_color, float):
        properties["base_color"] = {"type": "rgb", "value": base_color}
    return mi.load_dict({"type": NAME, **properties})


def register_bsdf() -> None:
    """Register the Mitsuba plugin ``metallicroughness`` for the active variant."""
    _registered(str(mi.variant()))


@dataclass
class _Point:
    base_color: mi.Color3f
    roughness: mi.Float
    metallic: mi.Float


def _alpha(material: Material) -> mi.Float:
    return dr.maximum(dr.square(material.roughness), LEAST_ALPHA)


@cache
def _registered(_variant: str) -> None:
    """Make the class under the active variant, whose base class it needs."""

    class MetallicRoughness(mi.BSDF):
        """Inputs, textures or numbers: base_color (0.5), roughness (0.5), metallic (0)."""

        def __init__(self, properties: mi.Properties):
            super().__init__(properties)
            self.base_color = properties.get_texture("base_color", 0.5)
            self.roughness = properties.get_texture("roughness", 0.5)
            self.metallic = properties.get_texture("metallic", 0.0)
            self.table = BrdfTable.load()
            flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            if any(getattr(self, name).is_spatially_varying() for name in INPUTS):
                flags |= mi.BSDFFlags.SpatiallyVarying
            self.m_components, self.m_flags = [flags], flags

        def traverse(self, callback: Any) -> None:
            for name in INPUTS:
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def material(self, si: Any, active: Any) -> Material:
            return _Point(
                self.base_color.eval(si, active),
                self.roughness.eval_1(si, active),
                self.metallic.eval_1(si, active),
            )

        def glossy_share(self, layers: Layers) -> mi.Float:
            """Share of the samples for the glossy part, by the parts' albedos."""
            glossy, diffuse = mi.luminance(layers.specular), mi.luminance(layers.body)
            share = glossy / dr.maximum(glossy + diffuse, 1e-4)
            share = dr.clip(share, _LEAST_SHARE, 1 - _LEAST_SHARE)
            return dr.select(diffuse > 0, share, 1)

        def value_and_density(
            self, material: Material, layers: Layers, wi: mi.Vector3f, wo: mi.Vector3f
        ) -> tuple[mi.Color3f, mi.Float]:
            """f n.l and the density of :meth:`sample`, for directions above the surface."""
            alpha, half = _alpha(material), dr.normalize(wi + wo)
            mirrored = fresnel(material, dr.dot(wi, half), layers=layers)
            glossy, diffuse = seen_density(wi.z, half, alpha), dr.inv_pi * wo.z
            value = mirrored * (glossy * unhidden(wi.z, wo.z, alpha)) + layers.body * diffuse
            return value, dr.lerp(diffuse, glossy, self.glossy_share(layers))

        def eval_pdf(self, _ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            above = active & (si.wi.z > 0) & (wo.z > 0)
            material = self.material(si, above)
            layers = Layers.of(material, self.table, si.wi.z)
            value, density = self.value_and_density(material, layers, si.wi, wo)
            return dr.select(above, value, 0), dr.select(above, density, 0)

        def eval(self, _ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(_ctx, si, wo, active)[0]

        def pdf(self, _ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(_ctx, si, wo, active)[1]

        def sample(
            self, _ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
        ) -> tuple[mi.BSDFSample3f, Any]:
            active &= si.wi.z > 0
            material = self.material(si, active)
            layers = Layers.of(material, self.table, si.wi.z)
            half = visible_normal(si.wi, _alpha(material), sample2)
            diffuse = mi.warp.square_to_cosine_hemisphere(sample2)
            wo = dr.select(sample1 < self.glossy_share(layers), mi.reflect(si.wi, half), diffuse)
            value, density = self.value_and_density(material, layers, si.wi, wo)
            active &= (wo.z > 0) & (density > 0)
            drawn = mi.BSDFSample3f(wo)
            drawn.pdf, drawn.eta = dr.select(active, density, 0), 1.0
            drawn.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            drawn.sampled_component = mi.UInt32(0)
            return drawn, dr.select(active, value / dr.select(active, density, 1), 0)

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            return Layers.of(self.material(si, active), self.table, si.wi.z).body

        def has_attribute(self, name: str, _active: Any = True) -> Any:
            return mi.Bool(name in INPUTS)

        def eval_attribute_1(self, name: str, si: Any, active: Any = True) -> Any:
            return getattr(self, name).eval_1(si, active)

        def eval_attribute_3(self, name: str, si: Any, active: Any = True) -> Any:
            return getattr(self, name).eval_3(si, active)

        def to_string(self) -> str:
            inputs = ", ".join(f"{name}={getattr(self, name)}" for name in INPUTS)
            return f"MetallicRoughness[{inputs}]"

    mi.register_bsdf(NAME, MetallicRoughness)
