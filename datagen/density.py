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

TEXELS_A_FRAME = 64
"""Texels of a scene for each pixel of a frame: what is not in it, or behind, wants some as well."""

FEWEST, MOST = 2**20, 2**23
"""Bounds of that number, whatever the frames' size."""


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
    """Some cameras of each path that pictures are taken from."""
    recipe = settings.split(spec.split)
    captures = {"captures": settings.capture, "pseudo_captures": settings.pseudo_capture}
    if settings.mode in captures:
        capture = captures[settings.mode]
        return [spec.views(PATH_SAMPLES, capture.width, capture.height)]
    return [
        spec.views(PATH_SAMPLES, settings.view_width, settings.view_height),
        spec.cameras.film.cameras(PATH_SAMPLES, recipe.width, recipe.height),
    ]


def _suited(spec: SceneSpec, cameras: list[Camera]) -> float:
    """TEXELS_A_PIXEL at the median distance of cameras and things."""
    things = np.array([item.placement.position for item in spec.objects or spec.surroundings])
    places = np.array([camera.position for camera in cameras])
    distance = float(np.median(np.linalg.norm(places[:, None] - things, axis=-1)))
    return TEXELS_A_PIXEL * cameras[0].fx / max(distance, NEAREST)
