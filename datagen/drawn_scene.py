"""A scene of the plan, drawn from its seed and built."""

from __future__ import annotations

from collections.abc import Sequence

from datagen.assets import load_models
from datagen.build import Geometry
from datagen.clock import stage
from datagen.lights import LightChoice
from datagen.motion import Share
from datagen.parts import outline
from datagen.plan import Sources, Work
from datagen.scene import SceneSpec, draw_scene
from datagen.scene_geometry import scene_geometry
from datagen.settings import Settings
from datagen.source_list import of_split, slots
from datagen.styles import Choice


@stage("build")
def draw_and_build(
    item: Work, settings: Settings, sources: Sources, lights: Sequence[LightChoice]
) -> tuple[SceneSpec, Geometry]:
    """A scene's specification, with a light of each of the given families, and its meshes."""
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
