"""The user's own environment maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from datagen.world.lights.light import Light
from datagen.world.spec import Number
from tron.shading.environments.contrast import Contrast
from tron.shading.environments.environment import EnvironmentMap


class HdriSpec(Light):
    """File of the user's, turned about z: its path within the environments folder, its hash, its contrast."""

    number = 3
    family: Literal["hdri"] = "hdri"
    path: str
    sha256: str
    rotation_deg: Number
    contrast: Contrast

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[Light]) -> Light:
        """One of the user's maps, turned."""
        chosen = files[int(rng.integers(len(files)))]
        return chosen.model_copy(update={"rotation_deg": round(float(rng.uniform(0.0, 360.0)), 6)})

    def bake(self, height: int, environments: Path | None = None) -> EnvironmentMap:
        """Read the file's map, averaged down where it has more rows, never up.

        Raises:
            TronError: the file is missing or no environment map.
        """
        environment = EnvironmentMap.load(f"{environments}/{self.path}", self.rotation_deg)
        return environment if environment.image.shape[0] <= height else environment.resized(height)
