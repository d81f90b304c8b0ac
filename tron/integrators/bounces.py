"""Bounced light for a plugin: transport kept until surfels move, direct light until they or the light change.

Where gradients are wanted the bounces themselves are gathered anew at each render, attached to the materials:
light that has met a surfel carries the gradient of its base color.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from tron.estimation import Estimation
from tron.gaussians.fields import MATERIALS, PARAMETERS
from tron.integrators.surfels import Surfels
from tron.shading.bounce import BouncedLight, BounceTransport, at_surfels
from tron.shading.lighting import Lighting

GEOMETRY = tuple(name for name in PARAMETERS if name not in (*MATERIALS, "sh"))


class Bounces:
    """Bakes of a plugin's surfels.

    Args:
        surfels: the plugin's.
        estimation: of its frames.
    """

    def __init__(self, surfels: Surfels, estimation: Estimation) -> None:
        self.surfels, self.estimation = surfels, estimation
        self._transport: tuple[Any, BounceTransport] | None = None
        self._direct: tuple[Any, mi.Color3f] | None = None

    def bake(self, lighting: Lighting) -> BouncedLight:
        """The light of ``lighting`` at each surfel, attached to materials whose gradients are wanted.

        Its rays are those of seed 0, whatever the sensor's.
        """
        geometry = self.surfels.state(*GEOMETRY)
        with dr.suspend_grad():
            if self._transport is None or self._transport[0] != geometry:
                self._transport = (
                    geometry,
                    BounceTransport.trace(self.surfels.tracer.sided(self.estimation.two_sided)),
                )
                self._direct = None
            transport = self._transport[1]
            if self._direct is None or self._direct[0] is not lighting:
                self._direct = lighting, transport.direct(lighting, at_surfels(self.estimation))
        return transport.bounced(self._direct[1], self.estimation)
