"""Geometry of a scene with the settings of a run and the user's models and textures."""

from __future__ import annotations

from datagen.assets import load_models
from datagen.build import Geometry, build
from datagen.density import most_texels, texels_per_unit
from datagen.materials import PhotographedSpec
from datagen.materials.photographed import Photographed
from datagen.plan import Sources
from datagen.scene import SceneSpec
from datagen.settings import Settings
from datagen.texture_sets import opened


def scene_geometry(spec: SceneSpec, settings: Settings, sources: Sources) -> Geometry:
    """Build a scene; models are read once a process, texture sets at the size that the scene needs.

    Raises:
        TronError: the scene names an asset or a texture set that is not among the sources.
    """
    models = load_models(settings.assets, sources.assets) if settings.assets is not None else {}
    density = texels_per_unit(spec, settings)

    def photographed(material: PhotographedSpec) -> Photographed:
        return opened(material, settings.textures, sources.textures, density)

    most = most_texels(spec, settings)
    return build(spec, models, settings.mesh_edge, density, most_texels=most, photographed=photographed)
