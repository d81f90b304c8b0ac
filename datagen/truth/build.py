"""Build a Mitsuba scene from a SceneSpec.

All procedural objects and what surrounds them are one mesh under one material whose parameters and normals
come from one atlas. Every synthetic scene then has the same kernel, whatever it holds: Dr.Jit compiles it
once and finds it in its cache for all others. Parts of the user's models bring a mesh and a material each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from datagen.clock import stage
from datagen.dataset.records import Work
from datagen.files.assets import load_models
from datagen.files.sources import Sources, of_split, slots
from datagen.files.texture_sets import opened
from datagen.settings.command import Settings
from datagen.truth import texels
from datagen.world.lights import LightChoice
from datagen.world.materials import PhotographedSpec
from datagen.world.materials.material import Unsaid
from datagen.world.materials.photographed import Photographed
from datagen.world.motion import Pose, Share
from datagen.world.scene import SceneSpec, draw_scene
from datagen.world.shapes import make_pieces, split_creases
from datagen.world.styles import Choice
from tron.brdf.bsdf import metallic_roughness
from tron.cameras import Camera
from tron.errors import TronError
from tron.models.parts import Part, outline
from tron.models.shapes import Shape, flat, mitsuba_mesh, mitsuba_texture, textured
from tron.shading.environments.environment import EnvironmentMap

FIRST_ID = 1
"""Object id of the first of the surroundings; 0 is nothing."""

TEXELS_A_PIXEL = 2.0
"""Texels along a pixel's side at the distance that things are seen from: bilinear lookups blur about one."""

NEAREST = 1.0
"""Least distance, world units, that textures are made for; nearer than that they are seen coarser."""

PATH_SAMPLES = 8
"""Cameras of a path that its distance is taken from."""

TEXELS_A_FRAME = 64
"""Texels of a scene for each pixel of a frame: what is not in it, or behind, wants some as well."""

FEWEST, MOST = 2**20, 2**23
"""Bounds of that number, whatever the frames' size."""


class _Solid(NamedTuple):
    """A piece in its object's frame, with placement and id of the object."""

    surface: texels.Surface
    matrix: np.ndarray
    object_id: int


@dataclass
class Surface(Shape):
    """A mesh of the scene, and the object of each triangle.

    Attributes:
        object_id: (F,) uint32 object of each triangle.
        rest: (V, 3) positions and normals before anything moved.
    """

    object_id: np.ndarray
    rest: tuple[np.ndarray, ...] | None = None


@dataclass
class Geometry:
    """A scene without its light."""

    surfaces: list[Surface]

    def move(self, object_id: int, pose: Pose) -> None:
        """Move an object from its rest place to its place at a time; existing scenes do not change."""
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
            parameters["vertex_positions"], parameters["vertex_normals"] = flat(positions), flat(normals)
            parameters.update()

    def lit(self, environment: EnvironmentMap | None = None) -> mi.Scene:
        """Return the Mitsuba scene under a light; without a light it still traces rays."""
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
                if item.unsaid:
                    material = Unsaid(material)
                solids.append(_Solid(texels.Surface(*split_creases(mesh), material), matrix, number))
            continue
        parts = (models or {}).get(str(item.asset))
        if parts is None:
            raise TronError(
                f"the scene needs the asset {item.asset!r}", spec.name, "give its folder as assets=..."
            )
        surfaces += [_of_model(part.moved(matrix, item.size), number, i) for i, part in enumerate(parts)]
    return Geometry([_solids(solids, texels_per_unit, most_texels), *surfaces])


def _solids(solids: Sequence[_Solid], texels_per_unit: float, most: int = texels.MOST_TEXELS) -> Surface:
    """Return all procedural pieces as one mesh with one material and one texture atlas."""
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
    textures = (atlas.base_color, atlas.roughness, atlas.metallic)
    material = metallic_roughness(*(mitsuba_texture(image, half=True) for image in textures))
    normal_map = mi.load_dict(mitsuba_texture(atlas.normal_map, half=True))
    bsdf: Any = mi.load_dict({"type": "normalmap", "normalmap": normal_map, "bsdf": material})
    # Cloth, leaves and walls are open; a back face that renders black would not match its surfels.
    bsdf = mi.load_dict({"type": "twosided", "bsdf": bsdf})
    points, directions, triangles, places = map(np.concatenate, (vertices, normals, faces, uvs))
    mesh = mitsuba_mesh("solids", bsdf, points, directions, triangles, places)
    return Surface(mesh, material, normal_map, np.concatenate(ids))


def _of_model(part: Part, object_id: int, index: int) -> Surface:
    made = textured(part, f"object{object_id}-{index}")
    return Surface(**vars(made), object_id=np.full(len(part.faces), object_id, np.uint32))


@stage("build")
def draw_and_build(
    item: Work, settings: Settings, sources: Sources, lights: Sequence[LightChoice]
) -> tuple[SceneSpec, Geometry]:
    """Return a scene's specification, with a light of each given family, and its meshes."""
    recipe = settings.split(item.split)
    checked, sources = slots(settings, sources), of_split(settings, sources, item.split)
    models = load_models(settings.assets, sources.assets) if settings.assets is not None else {}
    spec = draw_scene(
        settings.seed,
        item.split,
        item.index,
        style=recipe.style_of(item.index),
        lights=lights,
        families=settings.light_families(),
        environments=sources.environments,
        map_share=settings.map_share * (checked.map_share if checked else 1.0),
        choice=Choice(
            assets={name: outline(parts) for name, parts in models.items()},
            asset_share=settings.asset_share * (checked.model_share if checked else 1.0),
            objects=settings.objects,
            things=tuple(recipe.things),
            materials=tuple(recipe.materials),
            textures=sources.textures,
            texture_share=settings.texture_share,
        ),
        frames=recipe.frames,
        path_frames=settings.path_frames,
        lights_share_path=recipe.lights_share_path,
        moving=Share(recipe.moving_objects, recipe.moving_lights),
        still_camera=recipe.still_camera,
    )
    return spec, scene_geometry(spec, settings, sources)


def scene_geometry(spec: SceneSpec, settings: Settings, sources: Sources) -> Geometry:
    """Build a scene; models are read once per process, texture sets at the size for the scene.

    Raises:
        TronError: the scene names an asset or a texture set that is not among the sources.
    """
    models = load_models(settings.assets, sources.assets) if settings.assets is not None else {}
    density = texels_per_unit(spec, settings)

    def photographed(material: PhotographedSpec) -> Photographed:
        return opened(material, settings.textures, sources.textures, density)

    most = most_texels(spec, settings)
    return build(spec, models, settings.mesh_edge, density, most_texels=most, photographed=photographed)


def texels_per_unit(spec: SceneSpec, settings: Settings) -> float:
    """Texels a world unit of a scene: the setting, or what suits the frames and views that are made of it."""
    if settings.texels_per_unit is not None:
        return settings.texels_per_unit
    return max(_suited(spec, cameras) for cameras in _cameras(spec, settings))


def most_texels(spec: SceneSpec, settings: Settings) -> int:
    """Texels of a scene at most."""
    if settings.texels_per_unit is not None:
        return MOST
    pixels = max(cameras[0].width * cameras[0].height for cameras in _cameras(spec, settings))
    return int(np.clip(TEXELS_A_FRAME * pixels, FEWEST, MOST))


def _cameras(spec: SceneSpec, settings: Settings) -> list[list[Camera]]:
    """Return some cameras of each camera path."""
    captures = {"captures": settings.capture, "pseudo_captures": settings.pseudo_capture}
    if settings.mode in captures:
        capture = captures[settings.mode]
        return [spec.views(PATH_SAMPLES, capture.width, capture.height)]
    recipe, made = settings.split(spec.split), settings.surfel_budget(spec.split, spec.index)
    return [
        spec.views(PATH_SAMPLES, made.view_width, made.view_height),
        spec.cameras.film.cameras(PATH_SAMPLES, *max(recipe.pictures)),
    ]


def _suited(spec: SceneSpec, cameras: list[Camera]) -> float:
    """TEXELS_A_PIXEL at the median distance of cameras and things."""
    things = np.array([item.placement.position for item in spec.objects or spec.surroundings])
    places = np.array([camera.position for camera in cameras])
    distance = float(np.median(np.linalg.norm(places[:, None] - things, axis=-1)))
    return TEXELS_A_PIXEL * cameras[0].fx / max(distance, NEAREST)
