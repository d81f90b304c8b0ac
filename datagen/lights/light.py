"""Base of the families of light: a distribution, a radiance, and the map that it is baked to."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from datagen.lights.discs import Disc, lay
from datagen.spec import Spec
from tron.shading.environment import EnvironmentMap

SUPERSAMPLES = 4
"""Directions a texel and axis when a map is baked, unless a family says fewer: a sun two texels wide keeps
its energy."""


class Light(Spec):
    """Light at infinity around the scene: the specification of one family, its distribution and its radiance.

    Attributes:
        family: name in recipes, specifications and clips: a Literal with its default.
        in_any: whether ``any`` draws the family in styles A and B where a recipe names none. True changes
            what seeds give.
        supersamples: directions a texel and axis that :meth:`radiance` is averaged over. Small bright sources
            belong to :meth:`discs`, which need none.
    """

    family: str
    in_any: ClassVar[bool] = False
    supersamples: ClassVar[int] = SUPERSAMPLES

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[Light]) -> Light:
        """Draw a light; ``files`` are the user's maps, for the family that takes one of them."""
        raise NotImplementedError

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) that comes from unit directions (N, 3), world, z up."""
        raise NotImplementedError

    def discs(self) -> Sequence[Disc]:
        """Small bright sources that are added to the radiance, each with all of its light."""
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
