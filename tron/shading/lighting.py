"""An environment made ready to light frames: what is drawn from, and what is looked up."""

from __future__ import annotations

from copy import copy

from tron.errors import TronError
from tron.shading.cubemap import CubemapLight
from tron.shading.environment import EnvironmentLight, EnvironmentMap
from tron.shading.split_sum import CUBEMAP_RESOLUTION, SplitSum


class Lighting:
    """An environment prepared once for every frame that it lights.

    Args:
        environment: the light; of a cubemap everything is differentiable by its texels.
        cubemap_resolution: see :class:`SplitSum`.
    """

    def __init__(
        self, environment: EnvironmentMap | CubemapLight, cubemap_resolution: int = CUBEMAP_RESOLUTION
    ) -> None:
        drawn = isinstance(environment, EnvironmentMap)
        self.light = EnvironmentLight(environment) if drawn else environment
        self.split_sum = SplitSum(self.light, cubemap_resolution)

    def turned_to(self, rotation_deg: float) -> Lighting:
        """The same environment at another rotation about +z, in microseconds: lookups are turned.

        Raises:
            TronError: the light is a cubemap.
        """
        if isinstance(self.light, CubemapLight):
            raise TronError("a cubemap does not turn", mend="turn its to_environment()")
        other = copy(self)
        other.light = self.light.turned_to(rotation_deg)
        other.split_sum = self.split_sum.turned_to(rotation_deg)
        return other
