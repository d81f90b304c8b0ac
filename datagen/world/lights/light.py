"""Base class of light families: a distribution, a radiance, and a baked map.

Beside it what families share (directions, soft edges, tints, small bright discs).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from datagen.world.spec import Spec
from tron.shading.environments.environment import EnvironmentMap

SUPERSAMPLES = 4
"""Directions a texel and axis when a map is baked, unless a family says fewer: a sun two texels wide keeps
its energy."""


class Light(Spec):
    """Light at infinity around the scene: the specification of one family, its distribution and its radiance.

    Attributes:
        family: name in recipes, specifications and clips: a Literal with its default.
        number: place in the order in which seeds number families; another order changes what seeds give.
        usual: places among those that ``any`` draws from; 0: it never does.
        supersamples: directions a texel and axis that :meth:`radiance` is averaged over. Small bright sources
            belong to :meth:`discs`, which need none.
    """

    family: str
    number: ClassVar[int] = 99
    usual: ClassVar[int] = 0
    supersamples: ClassVar[int] = SUPERSAMPLES

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[Light]) -> Light:
        """Draw a light; ``files`` are the user's maps, used by one family only."""
        raise NotImplementedError

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        """Return linear radiance (N, 3) from unit directions (N, 3), world, z up."""
        raise NotImplementedError

    def discs(self) -> Sequence[Disc]:
        """Return small bright sources, which are added to the map with their exact irradiance."""
        return ()

    def bake(self, height: int, environments: Path | None = None) -> EnvironmentMap:  # noqa: ARG002
        """Make the environment map, ``height`` rows and twice as many columns, linear radiance.

        ``environments`` is the folder of the user's maps.
        """
        # Rows stand on the poles: half a texel more on either side is clipped back onto the sphere.
        count = self.supersamples
        fine = (np.arange(count) + 0.5) / count - 0.5
        v = np.clip((np.arange(height)[:, None] + fine) / (height - 1), 0.0, 1.0).ravel()
        u = ((np.arange(2 * height)[:, None] + 0.5 + fine) / (2 * height)).ravel()
        theta, phi = np.meshgrid(v * np.pi, u * 2 * np.pi, indexing="ij")
        directions = np.stack(
            [np.sin(theta) * np.sin(phi), np.sin(theta) * np.cos(phi), np.cos(theta)], axis=-1
        )
        image = self.radiance(directions.reshape(-1, 3))
        image = image.reshape(height, count, 2 * height, count, 3).mean(axis=(1, 3)).astype(np.float32)
        return EnvironmentMap(lay(image, discs) if (discs := self.discs()) else image)


def direction(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Unit vector (3,), world, z up; azimuth from +x towards +y."""
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def edge(distance_deg: np.ndarray, softness_deg: float) -> np.ndarray:
    """Smoothstep from 0 at -softness to 1 at +softness."""
    return _fade(distance_deg / (2.0 * softness_deg) + 0.5)


def smoothstep(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Smoothstep from 0 at ``low`` to 1 at ``high``."""
    return _fade((x - low) / (high - low))


def _fade(t: np.ndarray) -> np.ndarray:
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def tint(rng: np.random.Generator, strength: float) -> np.ndarray:
    """A colour (3,) of luminance about one, from cool to warm."""
    warmth = rng.uniform(-strength, strength)
    return np.array([1.0 + warmth, 1.0 + 0.1 * rng.uniform(-strength, strength), 1.0 - warmth])


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
    """Add discs to a lat-long image (H, W, 3) so that the map's own integral gives their irradiance."""
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
