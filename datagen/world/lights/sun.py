"""Sun in a clear sky."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Self

import numpy as np

from datagen.world.lights.light import Light, direction
from datagen.world.lights.weather import Sky
from datagen.world.spec import Number, Triple


class SunSpec(Light):
    """Sun and sky after Hosek and Wilkie, as Mitsuba's ``sunsky`` has them.

    Angles in degrees, azimuth from +x towards +y; ``aperture_deg`` is the sun's diameter. The sun keeps its
    power when it grows: wider than the true 0.53 degrees, it fits the texels of a small map. ``ground`` is
    the linear albedo of the plain seen below the horizon.
    """

    number = 0
    usual = 2
    family: Literal["sun"] = "sun"
    azimuth_deg: Number
    elevation_deg: Number
    turbidity: Number
    aperture_deg: Number
    ground: Triple

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[Light]) -> Self:  # noqa: ARG003
        return cls(
            azimuth_deg=rng.uniform(0.0, 360.0),
            elevation_deg=np.degrees(np.arcsin(rng.uniform(0.3, 0.92))),
            turbidity=rng.uniform(2.0, 6.0),
            aperture_deg=rng.uniform(2.5, 5.0),
            ground=tuple(rng.uniform(0.08, 0.3) * (1.0 + rng.uniform(-0.3, 0.3, 3))),
        )

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        sun = direction(self.azimuth_deg, self.elevation_deg)
        sky = Sky(sun, self.turbidity, float(np.mean(self.ground)))
        upper = directions[:, 2] > 0.0
        light = np.maximum(sky.dome(directions) + sky.disc(directions, self.aperture_deg), 0.0)
        # The model is black below the horizon; what is really seen there is sunlit ground.
        z = directions[upper, 2:]
        across = np.sin(np.arccos(z))
        mean = (across * z * light[upper]).sum(axis=0) / across.sum()
        ground = np.asarray(self.ground) * 2.0 * mean
        return np.where(upper[:, None], light, ground)
