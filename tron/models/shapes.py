"""Parts of models as Mitsuba has them: meshes with their materials, and what rays meet of them."""

# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.brdf.bsdf import metallic_roughness
from tron.runtime import aligned

if TYPE_CHECKING:
    from tron.models.parts import Part, Sampling


@dataclass
class Shape:
    """One Mitsuba mesh and what is needed to read its true materials at a hit.

    Attributes:
        shape: the mesh, with its material.
        material: the innermost BSDF, which knows base color, roughness and metallic.
        normal_map: texture of tangent-space normals as (n + 1) / 2, or None.
    """

    shape: mi.Mesh
    material: mi.BSDF
    normal_map: mi.Texture | None

    def elsewhere(self, part: Part) -> Shape:
        """The same material on a part whose vertices have moved."""
        return replace(self, shape=_shape(part, self.shape.id(), self.shape.bsdf()))


def textured(part: Part, name: str) -> Shape:
    """A part of a model, with the material that its textures say; ``name`` is the mesh's in Mitsuba."""
    look = part.sampling.get
    base_color = (
        {"type": "mesh_attribute", "name": "vertex_base_color"}
        if part.base_color.ndim == 2
        else mitsuba_texture(part.base_color, look("base_color"))
    )
    if part.tint is not None:
        base_color = tinted(base_color)
    material = metallic_roughness(
        base_color,
        mitsuba_texture(part.roughness, look("roughness")),
        mitsuba_texture(part.metallic, look("metallic")),
    )
    bsdf: Any = material
    normal_map = None
    if part.normal_map is not None:
        normal_map = mi.load_dict(mitsuba_texture(part.normal_map, look("normal_map")))
        bsdf = mi.load_dict({"type": "normalmap", "normalmap": normal_map, "bsdf": material})
    # Models are often open shells; a back face that renders black would not match its surfels.
    bsdf = mi.load_dict({"type": "twosided", "bsdf": bsdf})
    return Shape(_shape(part, name, bsdf), material, normal_map)


def _shape(part: Part, name: str, bsdf: mi.BSDF) -> mi.Mesh:
    emitter = None
    if part.emission is not None:
        radiance = mitsuba_texture(part.emission, part.sampling.get("emission"))
        emitter = mi.load_dict({"type": "area", "radiance": radiance})
    made = mitsuba_mesh(name, bsdf, part.vertices, part.normals, part.faces, part.uv, emitter)
    if part.base_color.ndim == 2:
        made.add_attribute("vertex_base_color", 3, flat(part.base_color))
    if part.tint is not None:
        made.add_attribute(ATTRIBUTE, 3, flat(part.tint))
    return made


def mitsuba_texture(value: np.ndarray | float, sampling: Sampling | None = None, half: bool = False) -> Any:
    """A constant or an image as Mitsuba texture; values are linear already, ``half`` halves their memory."""
    image = np.asarray(value, np.float32)
    if image.ndim == 0:
        return float(image)
    if image.ndim == 1:
        return {"type": "rgb", "value": image.tolist()}
    pixels = np.ascontiguousarray(image if image.ndim == 3 else image[..., None])
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
    if half:
        texture |= {"format": "fp16", "wrap_mode": "clamp"}
    if sampling is not None:
        texture |= {"to_uv": mi.ScalarTransform3f(sampling.matrix), "wrap_mode": sampling.wrap}
    return texture


def flat(values: np.ndarray) -> Any:
    """The numbers of an array as Mitsuba's parameters take them."""
    return aligned(np.ascontiguousarray(values, np.float32).ravel())


def mitsuba_mesh(
    name: str,
    bsdf: mi.BSDF,
    vertices: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray | None,
    emitter: mi.Emitter | None = None,
) -> mi.Mesh:
    """Triangles (F, 3) of ``vertices`` and unit ``normals`` (V, 3), and texture coordinates (V, 2) if any.

    ``emitter``: of an area, which its fronts are; None: it does not glow.
    """
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    if emitter is not None:
        properties["emitter"] = emitter
    mesh = mi.Mesh(
        name,
        len(vertices),
        len(faces),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=uv is not None,
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = flat(vertices)
    parameters["vertex_normals"] = flat(normals)
    parameters["faces"] = aligned(np.ascontiguousarray(faces, np.uint32).ravel())
    if uv is not None:
        parameters["vertex_texcoords"] = flat(uv)
    parameters.update()
    return mesh


@cache
def register_texture(_variant: str, name: str, color: Callable[[Any, Any, Any], Any]) -> None:
    """Make a texture known to the variant in use, whose class has to be made under it.

    Args:
        name: its plugin type; its inputs are ``image`` and ``metallic``, a texture each.
        color: linear RGB of the texture at a surface interaction.
    """

    class Derived(mi.Texture):
        """A texture computed from its inputs at the same point."""

        def __init__(self, properties: mi.Properties):
            super().__init__(properties)
            self.image: Any = properties.get_texture("image", 1.0)
            self.metallic = properties.get_texture("metallic", 0.0)

        def eval(self, si: Any, active: Any = True) -> Any:
            return self.eval_3(si, active)

        def eval_3(self, si: Any, active: Any = True) -> Any:
            return color(self, si, active)

        def eval_1(self, si: Any, active: Any = True) -> Any:
            return mi.luminance(self.eval_3(si, active))

        def mean(self) -> Any:
            return self.image.mean()

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            return f"{name}[{self.image}]"

    mi.register_texture(name, Derived)


ATTRIBUTE = "vertex_tint"


def tinted(image: dict[str, Any]) -> Any:
    """Mitsuba texture: that of a dictionary, times the mesh's attribute ``vertex_tint``; both linear RGB."""
    register_texture(str(mi.variant()), "tinted", _product)
    return mi.load_dict({"type": "tinted", "image": image})


def _product(texture: Any, si: Any, active: Any) -> mi.Color3f:
    return texture.image.eval_3(si, active) * si.shape.eval_attribute_3(ATTRIBUTE, si, active)


def surface_points(
    shapes: Sequence[Shape], scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool | bool = True
) -> tuple[mi.SurfaceInteraction3f, mi.Normal3f]:
    """First hits and their unit shading normals on the side of the ray's origin.

    Args:
        shapes: all of the scene's.
        scene: whose rays are answered.
        ray: world.
        active: lanes to trace; the others meet nothing.
    """
    si = scene.ray_intersect(ray, mi.Bool(active))
    normal = mi.Normal3f(si.sh_frame.n)
    for each in shapes:
        if each.normal_map is None:
            continue
        here = si.is_valid() & (si.shape == mi.ShapePtr(each.shape))
        bent = dr.normalize(2.0 * mi.Vector3f(each.normal_map.eval_3(si, here)) - 1.0)
        normal = dr.select(here, mi.Normal3f(si.sh_frame.to_world(bent)), normal)
    # Which side is seen is the triangle's affair: near silhouettes shading normals may well look away.
    normal = dr.select(dr.dot(si.n, ray.d) > 0.0, -normal, normal)
    return si, dr.normalize(normal)


def materials_at(
    shapes: Sequence[Shape], si: mi.SurfaceInteraction3f
) -> tuple[mi.Color3f, mi.Float, mi.Float]:
    """Linear base color, roughness and metallic of :func:`surface_points`; 0 where nothing is met."""
    base_color, roughness, metallic = mi.Color3f(0.0), mi.Float(0.0), mi.Float(0.0)
    for each in shapes:
        here = si.is_valid() & (si.shape == mi.ShapePtr(each.shape))
        base_color = dr.select(here, each.material.eval_attribute_3("base_color", si, here), base_color)
        roughness = dr.select(here, each.material.eval_attribute_1("roughness", si, here), roughness)
        metallic = dr.select(here, each.material.eval_attribute_1("metallic", si, here), metallic)
    return base_color, roughness, metallic


def emission_at(shapes: Sequence[Shape], si: mi.SurfaceInteraction3f) -> mi.Color3f | None:
    """Linear radiance that what is met emits towards the rays' origins; None where no shape glows."""
    glowing = [each.shape for each in shapes if each.shape.is_emitter()]
    emission = mi.Color3f(0.0)
    for shape in glowing:
        here = si.is_valid() & (si.shape == mi.ShapePtr(shape))
        emission = dr.select(here, shape.emitter().eval(si, here), emission)
    return emission if glowing else None
