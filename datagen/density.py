"""Density of a scene's textures: as fine as its cameras see them."""

from __future__ import annotations

import numpy as np

from datagen.scene import SceneSpec
from datagen.settings import Settings
from tron.cameras import Camera

TEXELS_A_PIXEL = 2.0
"""Texels along a pixel's side at the distance that things are seen from: bilinear lookups blur about one."""

NEAREST = 1.0
"""Least distance, world units, that textures are made for; nearer than that they are seen coarser."""

PATH_SAMPLES = 8
"""Cameras of a path that its distance is taken from."""


def texels_per_unit(spec: SceneSpec, settings: Settings) -> float:
    """Texels a world unit of a scene: the setting, or what suits the frames and views that are made of it."""
    if settings.texels_per_unit is not None:
        return settings.texels_per_unit
    recipe, captures = settings.split(spec.split), settings.captures
    if settings.mode == "captures":
        return _suited(spec, spec.views(PATH_SAMPLES, captures.width, captures.height))
    views = spec.views(PATH_SAMPLES, settings.view_width, settings.view_height)
    film = spec.cameras.film.cameras(PATH_SAMPLES, recipe.width, recipe.height)
    return max(_suited(spec, views), _suited(spec, film))


def _suited(spec: SceneSpec, cameras: list[Camera]) -> float:
    """TEXELS_A_PIXEL at the median distance of cameras to the nearest thing."""
    things = np.array([item.placement.position for item in spec.objects or spec.surroundings])
    places = np.array([camera.position for camera in cameras])
    nearest = np.linalg.norm(places[:, None] - things, axis=-1).min(axis=1)
    return TEXELS_A_PIXEL * cameras[0].fx / max(float(np.median(nearest)), NEAREST)
