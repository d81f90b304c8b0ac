"""Error of a fitted light: its irradiance on surfaces of all normals against the true light's irradiance.

Irradiance is compared, not radiance: it lights diffuse surfaces and is all that the fit saw. Differences
between neighbouring pixels of the map that only a mirror would show do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tron.color import luminance
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap

NORMALS = 500
SPOT_DEG = 10.0
SPOT_HEIGHT = 64
"""Rows of the maps in which the brightest spot is looked for."""
HEIGHT = 96
"""Rows that maps are averaged to before the sum over texels, which takes a texel's light as a point."""


def irradiance(lights: Sequence[EnvironmentMap], normals: np.ndarray) -> list[np.ndarray]:
    """Return irradiance / pi under each light on unoccluded surfaces of unit ``normals`` (N, 3), from texels.

    Returns:
        (N, 3) float64 for each light.
    """
    small = [light.baked().resized(HEIGHT) for light in lights]
    directions, solid_angles = texels(small[0])
    cosines = np.maximum(normals @ directions.T, 0) * (solid_angles / np.pi)
    return [cosines @ light.image.reshape(-1, 3).astype(np.float64) for light in small]


def texels(light: EnvironmentMap) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions (H W, 3) of a baked map's texels, row by row, and their solid angles (H W,)."""
    return light.directions().reshape(-1, 3), np.repeat(light.solid_angles(), light.image.shape[1])


def brightest_direction(light: EnvironmentMap) -> np.ndarray:
    """Return the unit direction (3,) of the brightest spot: centre of the light in the cone with most light.

    The centre of the light in the cone, not of the cone, is finer than a texel.
    """
    small = light.baked().resized(SPOT_HEIGHT)
    directions, solid_angles = texels(small)
    power = solid_angles * luminance(small.image.reshape(-1, 3).astype(np.float64))
    near = directions @ directions.T > np.cos(np.radians(SPOT_DEG))
    cone = near[np.argmax(near @ power)]
    centre = (cone * power) @ directions
    return centre / np.linalg.norm(centre)


def sun_error_deg(found: EnvironmentMap, truth: EnvironmentMap) -> float:
    """Return the angle between the brightest spots of two lights, degrees."""
    a, b = brightest_direction(found), brightest_direction(truth)
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def light_errors(found: EnvironmentMap, truth: EnvironmentMap) -> dict[str, float]:
    """Return relative L2 errors of irradiance over normals drawn evenly on the sphere.

    ``irradiance_error`` is without a factor; ``scaled_error`` is after the best factor, and so measures
    errors of colour and direction only.
    """
    normals = generator(0, "reconstruction", "light normals").normal(size=(NORMALS, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ours, wanted = irradiance([found, truth], normals)
    energy = float((ours * ours).sum())
    factor = float((ours * wanted).sum()) / energy if energy > 0 else 0.0
    size = float(np.linalg.norm(wanted))
    return {
        "irradiance_error": float(np.linalg.norm(ours - wanted)) / size,
        "scaled_error": float(np.linalg.norm(factor * ours - wanted)) / size,
    }


def read_light(folder: Path) -> EnvironmentMap | None:
    """Read the light of a capture or of a reconstruction; None if it has none."""
    path = folder / "environment.exr"
    return EnvironmentMap.load(path) if path.is_file() else None
