"""True maps of a view: what no photo tells of its surfaces and their light."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from datagen.build import Geometry
from datagen.pathtrace import direct_irradiance
from tron.cameras import Camera
from tron.gaussians.initialize import GBufferView

MAPS = ("normal", "base_color", "roughness", "metallic", "irradiance", "depth")
"""Fields of a view (``tron.captures.View``) that :func:`true_maps` gives."""


def true_maps(
    geometry: Geometry, scene: mi.Scene, camera: Camera, truth: GBufferView, spp: int, seed: int
) -> dict[str, np.ndarray]:
    """Maps of the pixel centres, each by its field of a view, zero where there is no surface.

    Args:
        geometry, scene: the meshes, and the same lit.
        camera: of the view.
        truth: its G-buffers (``datagen.pathtrace.gbuffers``).
        spp, seed: shadow rays per pixel of the irradiance and their stream.
    """
    direct = direct_irradiance(geometry, scene, camera, spp, seed)
    maps = {
        "normal": truth.normal,
        "base_color": truth.base_color,
        "roughness": truth.roughness,
        "metallic": truth.metallic,
        "irradiance": direct.shadowed,
        "depth": np.linalg.norm(truth.position - camera.position, axis=-1),
    }
    seen = truth.valid
    return {name: np.where(seen if x.ndim == 2 else seen[..., None], x, 0) for name, x in maps.items()}
