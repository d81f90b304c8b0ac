"""Discs: small bright sources, laid into a map with all of their light at any resolution."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from datagen.lights.directions import smoothstep
from tron.shading.environment import EnvironmentMap


@dataclass(frozen=True)
class Disc:
    """Round source at infinity.

    Attributes:
        toward: unit direction (3,) to its centre, world.
        diameter_deg: in degrees; a map may show it larger, as large as a texel needs, and as much dimmer.
        irradiance: (3,) linear, on a plane that faces it.
    """

    toward: np.ndarray
    diameter_deg: float
    irradiance: np.ndarray


def lay(image: np.ndarray, discs: Iterable[Disc]) -> np.ndarray:
    """The lat-long image (H, W, 3) with discs added: each gives its irradiance by the map's own integral."""
    environment = EnvironmentMap(image)
    height, width = image.shape[:2]
    area, directions = environment.solid_angles(), environment.directions()
    texel = np.pi / (height - 1)
    image = np.array(image, np.float64)
    for disc in discs:
        radius = max(np.radians(0.5 * disc.diameter_deg), 0.75 * texel)
        reach = radius + 0.5 * texel
        polar = np.arccos(np.clip(disc.toward[2], -1.0, 1.0))
        first = max(int(np.floor((polar - reach) / texel)), 0)
        rows = slice(first, min(int(np.ceil((polar + reach) / texel)) + 1, height))
        near = directions[rows].reshape(-1, 3)
        # A chord's length keeps its digits where the cosine of a small angle has none left.
        angle = 2 * np.arcsin(np.clip(0.5 * np.linalg.norm(near - disc.toward, axis=-1), 0.0, 1.0))
        share = smoothstep(-angle, -reach, 0.5 * texel - radius).reshape(-1, width)
        covered = (share * area[rows, None]).sum()
        image[rows] += share[..., None] * (np.asarray(disc.irradiance) / covered)
    return image.astype(np.float32)
