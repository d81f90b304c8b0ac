"""Error of a fitted light, by the irradiance that it and the true one give to surfaces of all normals.

Irradiance and not radiance is compared: it is what lights diffuse surfaces and all that the fit was given,
while a pixel of the map that only a mirror could tell from its neighbour is nobody's error.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tron.seeds import generator
from tron.shading.environment import EnvironmentMap

NORMALS = 500
HEIGHT = 96
"""Rows that maps are averaged to before the sum over texels, which takes a texel's light as a point."""


def irradiance(lights: Sequence[EnvironmentMap], normals: np.ndarray) -> list[np.ndarray]:
    """Irradiance / pi under each light on unoccluded surfaces of unit ``normals`` (N, 3): sums over texels.

    Returns:
        (N, 3) float64 for each light.
    """
    small = [light.baked().resized(HEIGHT) for light in lights]
    height, width = small[0].image.shape[:2]
    polar = np.arange(height)[:, None] * np.pi / (height - 1)  # rows stand on the poles
    around = (np.arange(width) + 0.5)[None] * 2 * np.pi / width  # from +y towards +x
    directions = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.sin(around), np.sin(polar) * np.cos(around), np.cos(polar)),
        axis=-1,
    ).reshape(-1, 3)
    weights = np.repeat(small[0].solid_angles(), width) / np.pi
    cosines = np.maximum(normals @ directions.T, 0) * weights
    return [cosines @ light.image.reshape(-1, 3).astype(np.float64) for light in small]


def light_errors(found: EnvironmentMap, truth: EnvironmentMap) -> dict[str, float]:
    """Relative L2 errors of irradiance over normals drawn evenly on the sphere.

    ``irradiance_error`` as it is; ``scaled_error`` after the one factor that makes it least, which
    leaves what is wrong with colour and direction.
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
    """The light of a capture or of a reconstruction; None if it has none."""
    path = folder / "environment.exr"
    return EnvironmentMap.load(path) if path.is_file() else None
