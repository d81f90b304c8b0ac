"""White balance and exposure of the camera of all photographs (``datagen.photographs``).

A phone assumes that the incident light on the visible surfaces is grey, and exposes their mean radiance as
middle grey: dark things become brighter, white things darker. Gains on channels of photos equal gains on the
light, so the light is changed and base color is kept.

Here only direct light is balanced to grey; the joint fit includes bounced light
(``tron.reconstruction.materials.joint_fit.light_balance``). In a red room they differ.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from datagen.settings.captures import ViewSettings
from datagen.truth.build import Geometry
from datagen.truth.pathtrace import direct_irradiance, gbuffers, render_frames
from datagen.world.scene import SceneSpec
from tron.color import MIDDLE_GREY, luminance
from tron.errors import TronError
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap

VIEWS, SPP = 8, 16
"""Views that are metered, and paths per pixel of them."""


def balanced(
    spec: SceneSpec, geometry: Geometry, environment: EnvironmentMap, settings: ViewSettings, stream: str
) -> tuple[EnvironmentMap, float]:
    """Return the light after white balance, and the metered exposure.

    Args:
        spec, geometry: the scene and its meshes.
        environment: its light before white balance.
        settings: size of the views.
        stream: name of the camera's random streams.

    Raises:
        TronError: no visible surface can be metered.
    """
    cameras = spec.views(VIEWS, settings.width, settings.height)
    scene = geometry.lit(environment)
    seeds = [integer(spec.seed, spec.split, spec.index, stream, "meter", n) for n in range(len(cameras))]
    frames = render_frames(scene, cameras, SPP, seeds, spec.path_bounces, transparent=True)
    arrived, returned = [], []
    for camera, seed, frame, truth in zip(cameras, seeds, frames, gbuffers(geometry, cameras), strict=True):
        direct = direct_irradiance(geometry, scene, camera, SPP, seed)
        arrived.append(direct.shadowed[truth.valid])
        returned.append(frame[(frame[..., 3] >= 1) & np.isfinite(frame).all(-1)][..., :3])
    seen = [np.concatenate(values) for values in (arrived, returned)]
    light, shown = (values.mean(axis=0) if len(values) else np.zeros(3) for values in seen)
    gains = luminance(light) / np.maximum(light, 1e-12)
    returns = float(luminance(shown * gains))
    if not 0 < returns < np.inf:
        raise TronError("nothing can be metered: no light comes back from what the camera sees", spec.name)
    if not (light > 0).all():
        raise TronError("white cannot be balanced: a colour channel has no light", spec.name)
    return replace(environment, image=environment.image * gains.astype(np.float32)), MIDDLE_GREY / returns
