"""Three lights to look at a scene in, by formula, and a light as the balls that film crews hold up.

Each light shows something else: a low sun shadows and relief, soft boxes reflections, a cloudy sky materials.
"""

from __future__ import annotations

import numpy as np

from tron.color import to_display
from tron.shading.environment import EnvironmentMap

HEIGHT = 128
"""Rows of the maps."""
BALL = 160
"""Pixels along a side of a ball's picture."""
_GREY = 0.5
_DIFFUSE_HEIGHT = 24
"""Rows of the map that a matt ball's light is summed over."""


def showcase_lights() -> dict[str, EnvironmentMap]:
    """Name -> light, linear radiance, z up."""
    empty = EnvironmentMap.constant(0.0, HEIGHT)
    d = empty.directions()
    return {
        name: EnvironmentMap(radiance.astype(np.float32))
        for name, radiance in (("low sun", _sun(d)), ("soft boxes", _boxes(d)), ("cloudy sky", _clouds(d)))
    }


def _sun(d: np.ndarray) -> np.ndarray:
    """A sun of 5 degrees, 28 degrees high, with three quarters of the light; blue sky; brown ground."""
    height = d[..., 2:]
    sky = np.array([0.25, 0.42, 0.75]) * (1.1 - 0.6 * np.maximum(height, 0))
    ground = np.array([0.16, 0.13, 0.10])
    return np.where(height > 0, sky, ground) + _disk(d, -50, 28, 2.5, 0.4) * np.array([400.0, 330.0, 235.0])


def _boxes(d: np.ndarray) -> np.ndarray:
    """A warm key light, a cool one from behind and a faint one from the side, in a dark room."""
    key = _disk(d, -60, 48, 20, 3) * np.array([11.0, 9.6, 8.0])
    rim = _disk(d, 120, 30, 13, 3) * np.array([6.0, 8.0, 11.0])
    fill = _disk(d, 200, 15, 24, 6) * np.array([1.2, 1.2, 1.2])
    return 0.05 + key + rim + fill


def _clouds(d: np.ndarray) -> np.ndarray:
    """The CIE overcast sky: a third as bright at the horizon as overhead; a grey ground."""
    height = d[..., 2:]
    return np.where(height > 0, (1 + 2 * height) / 3 * np.array([0.95, 1.0, 1.08]), 0.15)


def _disk(d: np.ndarray, azimuth: float, elevation: float, radius: float, softness: float) -> np.ndarray:
    """(..., 1): 1 within ``radius`` of a direction, 0 beyond, smoothly over ``softness``; all in degrees."""
    a, e = np.radians([azimuth, elevation])
    centre = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    angle = np.degrees(np.arccos(np.clip(d @ centre, -1, 1)))
    t = np.clip((radius - angle) / (2 * softness) + 0.5, 0, 1)[..., None]
    return t * t * (3 - 2 * t)


def ball_pictures(light: EnvironmentMap, exposure: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A mirror ball and a matt grey one in a light, each (BALL, BALL, 3) display values, seen level along +y.

    ``exposure``: the light's own unless given. Around the balls is the light behind them.
    """
    exposure = exposure or light.exposure()
    x, z = (np.stack(np.meshgrid(np.arange(BALL), np.arange(BALL)), -1) + 0.5).transpose(
        2, 0, 1
    ) / BALL * 2 - 1
    x, z = 1.08 * x, -1.08 * z
    inside = x * x + z * z < 1
    normal = np.stack([x, -np.sqrt(np.where(inside, 1 - x * x - z * z, 0)), z], axis=-1)
    view = np.array([0.0, 1.0, 0.0])
    mirrored = view - 2 * (normal @ view)[..., None] * normal
    behind = np.stack([0.5 * x, np.ones_like(x), 0.5 * z], axis=-1)
    behind /= np.linalg.norm(behind, axis=-1, keepdims=True)
    backdrop = light.lookup(behind.reshape(-1, 3)).reshape(BALL, BALL, 3)
    shining = light.lookup(mirrored.reshape(-1, 3)).reshape(BALL, BALL, 3)

    small = light.baked().resized(_DIFFUSE_HEIGHT)
    weights = np.repeat(small.solid_angles(), small.image.shape[1]) / np.pi
    cosines = np.maximum(normal.reshape(-1, 3) @ small.directions().reshape(-1, 3).T, 0) * weights
    matt = _GREY * (cosines @ small.image.reshape(-1, 3)).reshape(BALL, BALL, 3)
    where = inside[..., None]
    mirror, grey = (to_display(np.where(where, ball, backdrop), exposure) for ball in (shining, matt))
    return mirror, grey
