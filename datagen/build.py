"""SceneSpec -> Mitsuba scene.

All procedural objects and what surrounds them are one mesh under one ``principled`` material whose parameters
and normals come from one atlas. Every synthetic scene then has the same kernel, whatever it holds: Dr.Jit
compiles it once and finds it in its cache for all others. Parts of the user's models bring a mesh and a
material each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from datagen import texels
from datagen.materials import PhotographedSpec
from datagen.materials.photographed import Photographed
from datagen.motion import Pose
from datagen.parts import Part, Sampling
from datagen.scene import SceneSpec
from datagen.shapes import make_pieces, split_creases
from datagen.tint import ATTRIBUTE, tinted
from tron.aligned import aligned
from tron.errors import TronError
from tron.shading.environment import EnvironmentMap

FIRST_ID = 1
"""Object id of the first of the surroundings; 0 is nothing."""


class _Solid(NamedTuple):
    """A piece in its object's frame, where it stands, and its object's id."""

    surface: texels.Surface
    matrix: np.ndarray
    object_id: int


@dataclass
class Surface:
    """One Mitsuba mesh and what is needed to read its true materials at a hit.

    Attributes:
        shape: the mesh, with its material.
        principled: the innermost material, which knows base color, roughness and metallic.
        normal_map: texture of tangent-space normals as (n + 1) / 2, or None.
        object_id: (F,) uint32 object of each triangle.
        rest: (V, 3) positions and normals before anything moved.
    """

    shape: mi.Mesh
    principled: mi.BSDF
    normal_map: mi.Texture | None
    object_id: np.ndarray
    rest: tuple[np.ndarray, ...] | None = None


@dataclass
class Geometry:
    """A scene without its light."""

    surfaces: list[Surface]

    def move(self, object_id: int, pose: Pose) -> None:
        """Put an object where it is at a time, away from where it rests; scenes made before do not follow."""
        for surface in self.surfaces:
            if not (surface.object_id == object_id).any():
                continue
            parameters = mi.traverse(surface.shape)
            if surface.rest is None:
                surface.rest = tuple(
                    np.array(parameters[f"vertex_{name}"]).reshape(-1, 3) for name in ("positions", "normals")
                )
            faces = np.array(parameters["faces"]).reshape(-1, 3)
            which = np.unique(faces[surface.object_id == object_id])
            positions, normals = (array.copy() for array in surface.rest)
            positions[which] = (positions[which] - pose.pivot) @ pose.rotation.T + pose.pivot + pose.shift
            normals[which] = normals[which] @ pose.rotation.T
            parameters["vertex_positions"], parameters["vertex_normals"] = _flat(positions), _flat(normals)
            parameters.update()

    def lit(self, environment: EnvironmentMap | None = None) -> mi.Scene:
        """The Mitsuba scene under a light; without one it still answers rays."""
        scene: dict[str, Any] = {"type": "scene"}
        scene |= {f"surface{i}": surface.shape for i, surface in enumerate(self.surfaces)}
        if environment is not None:
            scene["environment"] = environment.to_mitsuba()
        return mi.load_dict(scene)


def build(
    spec: SceneSpec,
    models: Mapping[str, list[Part]] | None = None,
    edge: float = 0.05,
    texels_per_unit: float = 64.0,
    most_texels: int = texels.MOST_TEXELS,
    photographed: Callable[[PhotographedSpec], Photographed] | None = None,
) -> Geometry:
    """Build a scene's meshes and materials.

    Args:
        spec: the scene.
        models: asset id -> its parts (unit ball, z up), for the assets that the scene names.
        edge: longest edge of the procedural meshes, world units.
        texels_per_unit: density of the textures on them.
        most_texels: of all of them; where that is too few, the density falls.
        photographed: opens the user's texture sets, where the scene names some.

    Raises:
        TronError: the scene names an asset or a texture set that was not given.
    """
    solids, surfaces = [], []
    for number, item in enumerate((*spec.surroundings, *spec.objects), start=FIRST_ID):
        matrix = item.placement.matrix()
        if item.shape is not None and item.materials:
            # Subdivision rounds what is curved; walls, floors and terrain come as fine as they are.
            fine = np.inf if number < FIRST_ID + len(spec.surroundings) else edge
            for mesh, slot in make_pieces(item.shape, fine):
                material = item.materials[slot % len(item.materials)]
                if isinstance(material, PhotographedSpec):
                    if photographed is None:
                        raise TronError(
                            f"the scene needs the texture set '{material.texture_set}'",
                            spec.name,
                            "give its folder as textures=...",
                        )
                    material = photographed(material)
                solids.append(_Solid(texels.Surface(*split_creases(mesh), material), matrix, number))
            continue
        parts = (models or {}).get(str(item.asset))
        if parts is None:
            raise TronError(
                f"the scene needs the asset {item.asset!r}", spec.name, "give its folder as assets=..."
            )
        surfaces += [_textured(part.moved(matrix, item.size), number, i) for i, part in enumerate(parts)]
    return Geometry([_solids(solids, texels_per_unit, most_texels), *surfaces])


def _solids(solids: Sequence[_Solid], texels_per_unit: float, most: int = texels.MOST_TEXELS) -> Surface:
    """All procedural pieces as one mesh under one material, whose textures are one atlas."""
    atlas = texels.bake([solid.surface for solid in solids], texels_per_unit, most)
    vertices, normals, uvs, faces, ids, count = [], [], [], [], [], 0
    for (surface, matrix, object_id), (index, uv, corners) in zip(solids, atlas.laid):
        rotation = matrix[:3, :3]
        vertices.append(surface.vertices[index] @ rotation.T + matrix[:3, 3])
        normals.append(surface.normals[index] @ rotation.T)
        uvs.append(uv)
        faces.append(corners + count)
        ids.append(np.full(len(corners), object_id, np.uint32))
        count += len(index)
    principled = mi.load_dict(
        {
            "type": "principled",
            "base_color": _texture(atlas.base_color, half=True),
            "roughness": _texture(atlas.roughness, half=True),
            "metallic": _texture(atlas.metallic, half=True),
            "specular": 0.5,
        }
    )
    normal_map = mi.load_dict(_texture(atlas.normal_map, half=True))
    bsdf: Any = mi.load_dict({"type": "normalmap", "normalmap": normal_map, "bsdf": principled})
    # Cloth, leaves and walls are open; a back face that renders black would not match its surfels.
    bsdf = mi.load_dict({"type": "twosided", "bsdf": bsdf})
    mesh = _mesh("solids", bsdf, *(np.concatenate(part) for part in (vertices, normals, faces, uvs)))
    return Surface(mesh, principled, normal_map, np.concatenate(ids))


def _textured(part: Part, object_id: int, index: int) -> Surface:
    per_vertex = part.base_color.ndim == 2
    look = part.sampling.get
    base_color = (
        {"type": "mesh_attribute", "name": "vertex_base_color"}
        if per_vertex
        else _texture(part.base_color, look("base_color"))
    )
    if part.tint is not None:
        base_color = tinted(base_color)
    principled = mi.load_dict(
        {
            "type": "principled",
            "base_color": base_color,
            "roughness": _texture(part.roughness, look("roughness")),
            "metallic": _texture(part.metallic, look("metallic")),
            "specular": 0.5,
        }
    )
    bsdf: Any = principled
    normal_map = None
    if part.normal_map is not None:
        normal_map = mi.load_dict(_texture(part.normal_map, look("normal_map")))
        bsdf = mi.load_dict({"type": "normalmap", "normalmap": normal_map, "bsdf": principled})
    # Models are often open shells; a back face that renders black would not match its surfels.
    bsdf = mi.load_dict({"type": "twosided", "bsdf": bsdf})
    mesh = _mesh(f"object{object_id}-{index}", bsdf, part.vertices, part.normals, part.faces, part.uv)
    if per_vertex:
        mesh.add_attribute("vertex_base_color", 3, _flat(part.base_color))
    if part.tint is not None:
        mesh.add_attribute(ATTRIBUTE, 3, _flat(part.tint))
    return Surface(mesh, principled, normal_map, np.full(len(part.faces), object_id, np.uint32))


def _texture(value: np.ndarray | float, sampling: Sampling | None = None, half: bool = False) -> Any:
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


def _flat(values: np.ndarray) -> Any:
    return aligned(np.ascontiguousarray(values, np.float32).ravel())


def _mesh(
    name: str,
    bsdf: mi.BSDF,
    vertices: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray | None,
) -> mi.Mesh:
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    mesh = mi.Mesh(
        name,
        len(vertices),
        len(faces),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=uv is not None,
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = _flat(vertices)
    parameters["vertex_normals"] = _flat(normals)
    parameters["faces"] = aligned(np.ascontiguousarray(faces, np.uint32).ravel())
    if uv is not None:
        parameters["vertex_texcoords"] = _flat(uv)
    parameters.update()
    return mesh
