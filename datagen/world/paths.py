"""Camera paths as data: around a target by a spiral or an oscillation, or a walk through given places.

Angles in degrees, lengths in world units; the field of view is the horizontal one.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.interpolate import PchipInterpolator

from datagen.world.spec import Number, Pair, Spec, Triple
from tron.cameras import Camera
from tron.trajectories import oscillating, spiral


class SpiralPath(Spec):
    """Windings around a target from the lower to the upper elevation (:func:`tron.trajectories.spiral`)."""

    path: Literal["spiral"] = "spiral"
    target: Triple
    radius: Number
    fov_deg: Number
    elevation_deg: Pair = (10.0, 75.0)
    turns: Number = 3.0
    phase_deg: Number = 0.0

    def cameras(self, count: int, width: int, height: int) -> list[Camera]:
        """``count`` cameras, the first and the last of the path included."""
        return spiral(
            count,
            target=self.target,
            radius=self.radius,
            width=width,
            height=height,
            fov_deg=self.fov_deg,
            elevation_deg=self.elevation_deg,
            turns=self.turns,
            phase=self.phase_deg,
        )


class OscillatingPath(Spec):
    """A way around a target that rises and sinks (:func:`tron.trajectories.oscillating`); an orbit at 0."""

    path: Literal["oscillating"] = "oscillating"
    target: Triple
    radius: Number
    fov_deg: Number
    elevation_deg: Number
    amplitude_deg: Number
    azimuth_deg: Pair
    swings: Number = 1.5

    def cameras(self, count: int, width: int, height: int) -> list[Camera]:
        """``count`` cameras, the first and the last of the path included."""
        return oscillating(
            count,
            target=self.target,
            radius=self.radius,
            width=width,
            height=height,
            fov_deg=self.fov_deg,
            elevation_deg=self.elevation_deg,
            amplitude_deg=self.amplitude_deg,
            azimuth_deg=self.azimuth_deg,
            swings=self.swings,
        )


class WalkPath(Spec):
    """A walk through places, each with the point that is looked at there.

    Both are interpolated by monotone cubics (PCHIP: Fritsch and Butland 1984), which do not overshoot: a
    walk along a wall stays on its side of it.
    """

    path: Literal["walk"] = "walk"
    fov_deg: Number
    positions: tuple[Triple, ...] = Field(min_length=1)
    targets: tuple[Triple, ...] = Field(min_length=1)

    def cameras(self, count: int, width: int, height: int) -> list[Camera]:
        """``count`` cameras, the first and the last place included."""
        places = np.concatenate([self.positions, self.targets], axis=1)
        if len(places) > 1:
            keys = np.arange(len(places), dtype=np.float64)
            times = np.linspace(0.0, keys[-1], count)
            places = np.asarray(PchipInterpolator(keys, places)(times))
        else:
            places = np.repeat(places, count, axis=0)
        return [
            Camera.look_at(place[:3], place[3:], fov_deg=self.fov_deg, width=width, height=height)
            for place in places
        ]


PathSpec = Annotated[SpiralPath | OscillatingPath | WalkPath, Field(discriminator="path")]
