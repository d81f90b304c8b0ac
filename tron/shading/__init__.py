"""Light on a G-buffer: environment maps, split-sum, shadowed irradiance, guidance buffers.

Light is an :class:`EnvironmentMap` (NumPy, data at rest); :class:`Lighting` prepares what rendering needs of
it once, and :func:`render_guidance` turns a camera into the buffers the neural renderer is conditioned on.
Everything here is linear and scene-referred; exposure and AgX come at the very end, elsewhere.
"""

from tron.estimation import Estimation
from tron.shading.background import background_share
from tron.shading.bounce import BouncedLight, BounceTransport
from tron.shading.cubemap import CubemapLight
from tron.shading.environment import EnvironmentLight, EnvironmentMap
from tron.shading.fixed_rays import FixedRays
from tron.shading.guidance import Guidance, render_guidance
from tron.shading.irradiance import irradiance
from tron.shading.lighting import Lighting
from tron.shading.split_sum import SplitSum

__all__ = [
    "BounceTransport",
    "BouncedLight",
    "CubemapLight",
    "EnvironmentLight",
    "EnvironmentMap",
    "Estimation",
    "FixedRays",
    "Guidance",
    "Lighting",
    "SplitSum",
    "background_share",
    "irradiance",
    "render_guidance",
]
