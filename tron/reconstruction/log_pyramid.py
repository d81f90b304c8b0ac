"""Log radiance as a sum of cubemaps, each twice as fine as the one before: coarse patches move first.

Irradiance hardly depends on single texels, and Adam gives each of them steps of the same size whatever its
gradient, so texels fitted one by one end as noise. In a sum of levels, every texel of a coarse level moves
a whole patch of the sphere by a gradient in which the noise has averaged out, and finer levels, whose steps
are smaller, add what the coarse ones cannot show. Every light can still be represented, and nothing in the
loss prefers one: this is a preconditioner, not a regulariser. (Measured on a warehouse and eight views of
two spheres: the same error of irradiance, 1.6 %, and a picture without the noise.)
"""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.shading.cubemap import seamless, texel_directions

RATE_POWER = 1.0
"""Learning rates fall with a level's resolution to this power; at 0.5 single texels still show as noise."""


class LogPyramid:
    """The levels of a cubemap's log radiance and how they add up.

    Args:
        radiance: (6, R, R, 3) positive, linear: the finest level starts with all of it, the others with zero.
        coarsest: texels along a face edge of the coarsest level, at least 2; levels double up to R / 2, then
            R itself follows. R or more: the finest level alone, texels fitted one by one.

    Attributes:
        levels: names and first values of the parameters, 18 r^2 numbers each.
        finest: name of the level of resolution R.
    """

    def __init__(self, radiance: np.ndarray, coarsest: int) -> None:
        self.resolution = radiance.shape[1]
        self.finest = f"level_{self.resolution}"
        self._resolutions: dict[str, int] = {}
        resolution = coarsest
        while 2 * resolution <= self.resolution:
            self._resolutions[f"level_{resolution}"] = resolution
            resolution *= 2
        self._resolutions[self.finest] = self.resolution
        self._directions = texel_directions(self.resolution)
        dr.eval(self._directions)
        self.levels = {name: dr.zeros(mi.Float, 18 * r**2) for name, r in self._resolutions.items()}
        self.levels[self.finest] = mi.Float(np.log(radiance.astype(np.float64)).astype(np.float32).ravel())

    def rate(self, name: str) -> float:
        """Factor of a level's learning rate: 1 for the coarsest."""
        coarsest = min(self._resolutions.values())
        return (coarsest / self._resolutions[name]) ** RATE_POWER

    def compose(self, levels: Mapping[str, mi.Float]) -> mi.Float:
        """Log radiance r, g, b of the finest texels: the bilinear sum of all levels, differentiable."""
        total = levels[self.finest]
        for name, resolution in self._resolutions.items():
            if name != self.finest:
                total = total + dr.ravel(seamless(levels[name], resolution, self._directions))
        return total
