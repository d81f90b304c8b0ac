"""Path-trace meshes by Mitsuba, the truth of comparisons."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np

from tron.cameras import Camera, mitsuba_sensor
from tron.shading.environments.environment import EnvironmentMap


def scene_of(shapes: Sequence[mi.Mesh], light: EnvironmentMap | None = None) -> mi.Scene:
    """Return a Mitsuba scene of meshes with their materials, and a light around them, if any."""
    lamp = {} if light is None else {"light": light.to_mitsuba()}
    return mi.load_dict({"type": "scene", **lamp, **{f"shape{k}": shape for k, shape in enumerate(shapes)}})


def path_traced(
    shapes: Sequence[mi.Mesh], light: EnvironmentMap, camera: Camera, depth: int, paths: int, seed: int
) -> np.ndarray:
    """Render linear radiance (H, W, 3) of meshes by paths of up to ``depth`` edges, ``paths`` per pixel."""
    sensor = mitsuba_sensor(camera, paths)
    sensor["sampler"]["type"] = "multijitter"
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": depth})
    scene, seen = scene_of(shapes, light), mi.load_dict(sensor)
    image = mi.render(scene, sensor=seen, integrator=integrator, spp=paths, seed=mi.UInt32(seed % 2**32))
    return np.array(image)[..., :3]
