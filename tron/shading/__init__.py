"""Light on a G-buffer: environment maps, split-sum, shadowed irradiance, guidance buffers.

Light is an :class:`EnvironmentMap` (NumPy, data at rest); :class:`Lighting` prepares what rendering needs of
it once, and :func:`render_guidance` turns a camera into the buffers the neural renderer is conditioned on.
Everything here is linear and scene-referred; exposure and AgX come at the very end, elsewhere.
"""

from tron.estimation import Estimation
from tron.shading.bounces.bounce import BouncedLight, BounceTransport
from tron.shading.composition import background_share
from tron.shading.direct.irradiance import irradiance
from tron.shading.environments.cubemap import CubemapLight
from tron.shading.environments.environment import EnvironmentLight, EnvironmentMap
from tron.shading.guidance import Guidance, render_guidance
from tron.shading.lighting import Lighting, SplitSum

__all__ = [
    "BounceTransport",
    "BouncedLight",
    "CubemapLight",
    "EnvironmentLight",
    "EnvironmentMap",
    "Estimation",
    "Guidance",
    "Lighting",
    "SplitSum",
    "background_share",
    "irradiance",
    "render_guidance",
]
