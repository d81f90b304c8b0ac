"""The environment emitter of a Mitsuba scene -> EnvironmentMap.

An ``envmap`` that stands upright in a z-up world (a turn about +z after ``rotate([1, 0, 0], 90)``) is taken
texel by texel. Any other emitter (tilted, mirrored, of another shape, ``constant``, ``sunsky``) is asked for
its radiance on a grid finer than the map, and averaged.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.errors import TronError
from tron.integrators.held import Held
from tron.shading.environment import EnvironmentMap

SAMPLED_HEIGHT = 512
"""Rows of the map of an emitter that is not taken texel by texel."""
OVERSAMPLING = 3
"""Rows that are asked for, for each row of such a map."""


def environment_of(scene: mi.Scene) -> EnvironmentMap:
    """The light of ``scene`` from infinity, as the scene has it now.

    Raises:
        TronError: the scene has no environment emitter.
    """
    emitter = scene.environment()
    if emitter is None:
        raise TronError(
            "the scene has no environment to light the surfels",
            mend="add an emitter such as `envmap` or `constant` to it, or give the integrator `environment`",
        )
    if emitter.class_name() != "EnvironmentMapEmitter":
        return _sampled(emitter)
    parameters: Any = mi.traverse(emitter)
    image = np.array(parameters["data"])[:, 1:-1, :3]  # Mitsuba repeats a column at either side
    rotation = _turn_about_z(np.array(parameters["to_world"].matrix)[..., 0])
    if rotation is None or image.shape[1] != 2 * image.shape[0]:
        return _sampled(emitter)
    return EnvironmentMap(image * float(parameters["scale"][0]), rotation)


def light_state(scene: mi.Scene) -> list[Any]:
    """Equal for equal states of the scene's environment; changes when a parameter of it does."""
    emitter = scene.environment()
    if emitter is None:
        return []
    return [emitter.ptr, *(Held(value) for _, value in mi.traverse(emitter))]


def _turn_about_z(to_world: np.ndarray) -> float | None:
    """Degrees by which an upright map is turned about +z; None if it does not stand upright."""
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # rotate([1, 0, 0], 90)
    turn = to_world[:3, :3] @ upright.T
    angle = math.atan2(turn[1, 0], turn[0, 0])
    cos, sin = math.cos(angle), math.sin(angle)
    if np.abs(turn - [[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]).max() > 1e-5:
        return None
    return math.degrees(angle)


def _sampled(emitter: mi.Emitter) -> EnvironmentMap:
    """The emitter's radiance by directions; rows stand on the poles, columns on half texels."""
    rows = OVERSAMPLING * SAMPLED_HEIGHT
    texel = dr.arange(mi.UInt32, 2 * rows * rows)
    polar = mi.Float(texel // (2 * rows)) * (math.pi / (rows - 1))
    across, along = dr.sincos((mi.Float(texel % (2 * rows)) + 0.5) * (math.pi / rows))
    sin, cos = dr.sincos(dr.clip(polar, 1e-4, math.pi - 1e-4))  # at a pole an azimuth is anybody's guess
    si = dr.zeros(mi.SurfaceInteraction3f, 2 * rows * rows)
    si.wi = -mi.Vector3f(sin * across, sin * along, cos)
    radiance = mi.Color3f(emitter.eval(si)) + dr.zeros(mi.Color3f, 2 * rows * rows)
    return EnvironmentMap(np.array(radiance).T.reshape(rows, 2 * rows, 3)).resized(SAMPLED_HEIGHT)
