"""Light families: a drawn specification becomes one lat-long environment map.

sun       sun and sky after Hosek and Wilkie as Mitsuba's ``sunsky`` has them, baked; low contrast it is not
studio    soft boxes on a dark surround, some tinted
overcast  a soft dome, brighter above or to one side, over a dim ground
hdri      a file of the user's, turned about z

The same image lights Mitsuba's path tracer and the surfels, so whatever the bake rounds off is rounded off in
both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import Field

from datagen.spec import Number, Spec, Triple
from tron.shading.environment import EnvironmentMap

SUPERSAMPLES = 4
"""Directions a texel and axis when a map is baked: a sun two texels wide keeps its energy."""

HIGH_CONTRAST = 0.3
"""Share of the light from the brightest hundredth of the sphere above which a map casts distinct shadows."""


class SunSpec(Spec):
    """Sun and sky. Angles in degrees, azimuth from +x towards +y; ``aperture_deg`` is the sun's diameter.

    The sun keeps its power when it grows: wider than the true 0.53 degrees, it fits the texels of a small
    map. ``ground`` is the linear albedo of the plain seen below the horizon.
    """

    family: Literal["sun"] = "sun"
    azimuth_deg: Number
    elevation_deg: Number
    turbidity: Number
    aperture_deg: Number
    ground: Triple


class Panel(Spec):
    """A soft box at infinity: centre direction, half sizes and edge softness in degrees, linear radiance."""

    azimuth_deg: Number
    elevation_deg: Number
    roll_deg: Number
    half_width_deg: Number
    half_height_deg: Number
    softness_deg: Number
    radiance: Triple


class StudioSpec(Spec):
    """Soft boxes on a surround that fades from ``floor`` below to ``ceiling`` above (linear radiance)."""

    family: Literal["studio"] = "studio"
    panels: tuple[Panel, ...]
    floor: Triple
    ceiling: Triple


class OvercastSpec(Spec):
    """A cloudy dome: zenith and horizon radiance, a broad brighter patch, and the ground below (all linear).

    The dome is linear in sin(elevation): the CIE overcast sky where the horizon is a third of the zenith.
    """

    family: Literal["overcast"] = "overcast"
    zenith: Triple
    horizon: Triple
    ground: Triple
    patch_azimuth_deg: Number
    patch_elevation_deg: Number
    patch_width_deg: Number
    patch: Triple


class HdriSpec(Spec):
    """A file: its path within the environments folder, its hash, a rotation about z, its contrast."""

    family: Literal["hdri"] = "hdri"
    path: str
    sha256: str
    rotation_deg: Number
    contrast: Literal["high", "low"]


LightSpec = Annotated[SunSpec | StudioSpec | OvercastSpec | HdriSpec, Field(discriminator="family")]
Family = Literal["sun", "studio", "overcast", "hdri"]


def draw_light(rng: np.random.Generator, family: Family, files: Sequence[HdriSpec] = ()) -> LightSpec:
    """Draw a light of a family; ``files`` are the maps that family ``hdri`` chooses from (rotation drawn
    here).
    """
    if family == "sun":
        return _draw_sun(rng)
    if family == "studio":
        return _draw_studio(rng)
    if family == "overcast":
        return _draw_overcast(rng)
    chosen = files[int(rng.integers(len(files)))]
    return chosen.model_copy(update={"rotation_deg": round(float(rng.uniform(0.0, 360.0)), 6)})


def bake(light: LightSpec, height: int, environments: str | None = None) -> EnvironmentMap:
    """Make the environment map of a light, ``height`` rows, linear radiance.

    Args:
        light: the specification.
        height: rows; columns are twice as many. A file larger than that is averaged down, never up.
        environments: the folder that an HdriSpec's path is relative to.

    Raises:
        TronError: the file is missing or no environment map.
    """
    if isinstance(light, HdriSpec):
        environment = EnvironmentMap.load(f"{environments}/{light.path}", light.rotation_deg)
        return environment if environment.image.shape[0] <= height else environment.resized(height)
    radiance = {"sun": _sun, "studio": _studio, "overcast": _overcast}[light.family]
    # Rows stand on the poles: half a texel more on either side is clipped back onto the sphere.
    fine = (np.arange(SUPERSAMPLES) + 0.5) / SUPERSAMPLES - 0.5
    v = np.clip((np.arange(height)[:, None] + fine) / (height - 1), 0.0, 1.0).ravel()
    u = ((np.arange(2 * height)[:, None] + 0.5 + fine) / (2 * height)).ravel()
    theta, phi = np.meshgrid(v * np.pi, u * 2 * np.pi, indexing="ij")
    directions = np.stack([np.sin(theta) * np.sin(phi), np.sin(theta) * np.cos(phi), np.cos(theta)], axis=-1)
    image = radiance(light, directions.reshape(-1, 3))
    image = image.reshape(height, SUPERSAMPLES, 2 * height, SUPERSAMPLES, 3).mean(axis=(1, 3))
    return EnvironmentMap(image.astype(np.float32))


def classify(environment: EnvironmentMap) -> Literal["high", "low"]:
    """High contrast if the brightest hundredth of the sphere gives more than HIGH_CONTRAST of the light."""
    return "high" if environment.contrast() > HIGH_CONTRAST else "low"


def _direction(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def _tint(rng: np.random.Generator, strength: float) -> np.ndarray:
    """A colour of luminance about one, from cool to warm."""
    warmth = rng.uniform(-strength, strength)
    return np.array([1.0 + warmth, 1.0 + 0.1 * rng.uniform(-strength, strength), 1.0 - warmth])


def _draw_sun(rng: np.random.Generator) -> SunSpec:
    return SunSpec(
        azimuth_deg=rng.uniform(0.0, 360.0),
        elevation_deg=np.degrees(np.arcsin(rng.uniform(0.3, 0.92))),
        turbidity=rng.uniform(2.0, 6.0),
        aperture_deg=rng.uniform(2.5, 5.0),
        ground=tuple(rng.uniform(0.08, 0.3) * (1.0 + rng.uniform(-0.3, 0.3, 3))),
    )


def _draw_studio(rng: np.random.Generator) -> StudioSpec:
    panels = []
    for k in range(int(rng.integers(1, 5))):
        power = rng.uniform(10.0, 25.0) if k == 0 else rng.uniform(2.0, 12.0)
        panels.append(
            Panel(
                azimuth_deg=rng.uniform(0.0, 360.0),
                # The key light stands high enough to light the floor; fills may be anywhere above it.
                elevation_deg=rng.uniform(35.0, 75.0) if k == 0 else rng.uniform(5.0, 80.0),
                roll_deg=rng.uniform(0.0, 180.0),
                half_width_deg=rng.uniform(6.0, 20.0),
                half_height_deg=rng.uniform(6.0, 20.0),
                softness_deg=rng.uniform(1.0, 4.0),
                radiance=tuple(power * _tint(rng, 0.35)),
            )
        )
    ambient = rng.uniform(0.02, 0.15)
    return StudioSpec(
        panels=tuple(panels),
        floor=tuple(ambient * rng.uniform(0.3, 1.0) * _tint(rng, 0.2)),
        ceiling=tuple(ambient * _tint(rng, 0.2)),
    )


def _draw_overcast(rng: np.random.Generator) -> OvercastSpec:
    tint = _tint(rng, 0.15)
    return OvercastSpec(
        zenith=tuple(rng.uniform(0.9, 1.1) * tint),
        horizon=tuple(rng.uniform(0.25, 0.9) * _tint(rng, 0.12)),
        ground=tuple(rng.uniform(0.05, 0.35) * _tint(rng, 0.25)),
        patch_azimuth_deg=rng.uniform(0.0, 360.0),
        patch_elevation_deg=rng.uniform(15.0, 80.0),
        patch_width_deg=rng.uniform(20.0, 50.0),
        patch=tuple(rng.uniform(0.0, 2.0) * _tint(rng, 0.2)),
    )


def _sun(light: SunSpec, directions: np.ndarray) -> np.ndarray:
    emitter = mi.load_dict(
        {
            "type": "sunsky",
            "sun_direction": _direction(light.azimuth_deg, light.elevation_deg).tolist(),
            "turbidity": float(light.turbidity),
            "albedo": float(np.mean(light.ground)),
            "sun_aperture": float(light.aperture_deg),
        }
    )
    upper = directions[:, 2] > 0.0
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = -mi.Vector3f(np.ascontiguousarray(directions.T, np.float32))
    sky = np.array(emitter.eval(si)).T.astype(np.float64)
    # The plugin is black below the horizon; what is really seen there is sunlit ground.
    z = directions[upper, 2:]
    mean = (np.sin(np.arccos(z)) * z * sky[upper]).sum(axis=0) / np.sin(np.arccos(z)).sum()
    ground = np.asarray(light.ground) * 2.0 * mean
    return np.where(upper[:, None], np.maximum(sky, 0.0), ground)


def _studio(light: StudioSpec, directions: np.ndarray) -> np.ndarray:
    up = 0.5 + 0.5 * directions[:, 2:]
    image = np.asarray(light.floor) * (1.0 - up) + np.asarray(light.ceiling) * up
    for panel in light.panels:
        centre = _direction(panel.azimuth_deg, panel.elevation_deg)
        right = np.cross((0.0, 0.0, 1.0), centre)
        right /= np.linalg.norm(right)
        roll = np.radians(panel.roll_deg)
        above = np.cross(centre, right)
        right, above = (
            np.cos(roll) * right + np.sin(roll) * above,
            np.cos(roll) * above - np.sin(roll) * right,
        )
        depth = directions @ centre
        x = np.degrees(np.arctan2(np.abs(directions @ right), depth))
        y = np.degrees(np.arctan2(np.abs(directions @ above), depth))
        inside = _edge(panel.half_width_deg - x, panel.softness_deg) * _edge(
            panel.half_height_deg - y, panel.softness_deg
        )
        image = image * (1.0 - inside[:, None]) + inside[:, None] * np.asarray(panel.radiance)
    return image


def _overcast(light: OvercastSpec, directions: np.ndarray) -> np.ndarray:
    z = directions[:, 2:]
    share = np.maximum(z, 0.0)
    dome = np.asarray(light.horizon) * (1.0 - share) + np.asarray(light.zenith) * share
    centre = _direction(light.patch_azimuth_deg, light.patch_elevation_deg)
    angle = np.degrees(np.arccos(np.clip(directions @ centre, -1.0, 1.0)))
    dome = dome + np.exp(-0.5 * (angle / light.patch_width_deg) ** 2)[:, None] * np.asarray(light.patch)
    above = _edge(np.degrees(np.arcsin(np.clip(z, -1.0, 1.0))), 4.0)
    return dome * above + np.asarray(light.ground) * (1.0 - above)


def _edge(distance_deg: np.ndarray, softness_deg: float) -> np.ndarray:
    """Smoothstep from 0 at -softness to 1 at +softness."""
    t = np.clip(distance_deg / (2.0 * softness_deg) + 0.5, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
