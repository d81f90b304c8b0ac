"""Two lights for the irradiance figures: a small sun in a dim sky, and soft windows."""

from __future__ import annotations

import numpy as np

from tron.shading.environment import EnvironmentMap

HEIGHT = 128


def _angles() -> tuple[np.ndarray, np.ndarray]:
    """Elevation and azimuth of every texel, radians."""
    elevation = np.pi / 2 - np.linspace(0, np.pi, HEIGHT)[:, None]
    azimuth = (np.arange(2 * HEIGHT) + 0.5)[None] / (2 * HEIGHT) * 2 * np.pi
    return elevation, azimuth


def _spot(elevation_deg: float, azimuth_deg: float, radius_deg: float, soft_deg: float) -> np.ndarray:
    """(H, W) in [0, 1]: a disk of the sphere with a linear edge."""
    elevation, azimuth = _angles()
    e, a = np.radians(elevation_deg), np.radians(azimuth_deg)
    cosine = np.sin(elevation) * np.sin(e) + np.cos(elevation) * np.cos(e) * np.cos(azimuth - a)
    away = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return np.clip((radius_deg + soft_deg - away) / soft_deg, 0, 1)


def _sky(zenith: float, horizon: float, ground: float) -> np.ndarray:
    elevation, _ = _angles()
    up = np.clip(np.sin(elevation), 0, 1)
    sky = horizon + (zenith - horizon) * up
    return np.where(elevation > 0, sky, ground) * np.ones((1, 2 * HEIGHT))


def sun() -> EnvironmentMap:
    """A sun of two degrees' radius, 40 above the horizon; four fifths of an upward plane's light is its."""
    sky = _sky(0.3, 0.5, 0.12)[..., None] * np.array([0.8, 0.9, 1.1])
    disk = _spot(40, 250, 2.0, 1.5)[..., None] * np.array([1.05, 1.0, 0.9])
    share = EnvironmentMap(disk).unoccluded_upward().mean() / EnvironmentMap(sky).unoccluded_upward().mean()
    return EnvironmentMap(sky + disk * (4.0 / share))


def soft() -> EnvironmentMap:
    """Two wide windows and a dim room: penumbras everywhere."""
    room = _sky(0.25, 0.2, 0.1)[..., None] * np.ones(3)
    large = _spot(50, 220, 22, 10)[..., None] * np.array([1.0, 0.97, 0.9]) * 6
    small = _spot(25, 60, 14, 8)[..., None] * np.array([0.8, 0.9, 1.1]) * 4
    return EnvironmentMap(room + large + small)


LIGHTS = {"sun": sun, "soft": soft}
