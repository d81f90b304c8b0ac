"""Weather: sun, air and two layers of cloud, as seen from the ground, and the ground itself.

Clouds are shells of varying optical depth. What passes through them, and what they scatter towards us,
follows the two-stream picture (Bohren 1987): light goes straight through as exp(-depth), comes out diffuse
as 1 / (1 + (1 - g) depth), and the rest goes back, which we see on the side that faces the sun.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import drjit as dr
import mitsuba as mi
import numpy as np

from datagen.world.lights.light import Disc, direction, smoothstep
from datagen.world.lights.noise import Fractal
from datagen.world.spec import Number, Spec, Triple, between
from tron.runtime import lanes

_APERTURE_DEG = 5.0
_FEWEST = 16


@dataclass(frozen=True)
class Sky:
    """Clear sky and sun after Hosek and Wilkie (2012, 2013), by Mitsuba's ``sunsky``.

    Mitsuba writes the sun's aperture into a kernel's code and nothing else of a sky. So the disc is always
    evaluated at one aperture, at angles scaled to it, and no sky compiles a kernel that another has compiled.

    Attributes:
        sun: unit direction (3,) to the sun, world, z up, above the horizon.
        turbidity: of the air, 1 to 10.
        albedo: of the ground, which lights the sky from below.
    """

    sun: np.ndarray
    turbidity: float
    albedo: float

    def dome(self, directions: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) of the air alone along unit directions (N, 3); black below the horizon."""
        return self._evaluate(directions, sun_scale=0.0)

    def disc(self, directions: np.ndarray, aperture_deg: float) -> np.ndarray:
        """Linear radiance (N, 3) of the sun alone, ``aperture_deg`` wide and as strong as the true one."""
        image = np.zeros(directions.shape)
        inside = np.flatnonzero(directions @ self.sun > np.cos(np.radians(0.5 * aperture_deg)))
        toward = directions[inside]
        cosine = toward @ self.sun
        across = toward - cosine[:, None] * self.sun
        sine = np.linalg.norm(across, axis=1)
        # Limb darkening is a function of the sine relative to the rim's.
        sine_there = sine * np.sin(np.radians(0.5 * _APERTURE_DEG)) / np.sin(np.radians(0.5 * aperture_deg))
        there = (
            np.sqrt(1.0 - sine_there**2)[:, None] * self.sun
            + (sine_there / np.maximum(sine, 1e-12))[:, None] * across
        )
        wider = _cap(_APERTURE_DEG) / _cap(aperture_deg)
        if not len(inside):
            return image
        image[inside] = wider * self._evaluate(there, sky_scale=0.0, sun_aperture=_APERTURE_DEG)
        return image * (directions[:, 2:] > 0.0)

    def _evaluate(self, directions: np.ndarray, **scales: float) -> np.ndarray:
        emitter = mi.load_dict(
            {
                "type": "sunsky",
                "sun_direction": self.sun.tolist(),
                "turbidity": float(self.turbidity),
                "albedo": float(self.albedo),
                **scales,
            }
        )
        si = dr.zeros(mi.SurfaceInteraction3f, max(len(directions), _FEWEST))
        # Where NumPy's memory begins would be a part of the kernel, and so would a width of a few numbers.
        si.wi = -lanes(mi.Vector3f, np.resize(directions, (max(len(directions), _FEWEST), 3)))
        return np.array(emitter.eval(si)).T[: len(directions)].astype(np.float64)


def _cap(aperture_deg: float) -> float:
    """Solid angle of a disc, relative to the sphere's half."""
    return 1.0 - float(np.cos(np.radians(0.5 * aperture_deg)))


KINDS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "grass": ((0.07, 0.11, 0.03), (0.19, 0.19, 0.07)),
    "soil": ((0.12, 0.085, 0.055), (0.27, 0.20, 0.13)),
    "sand": ((0.30, 0.24, 0.16), (0.46, 0.38, 0.27)),
    "asphalt": ((0.045, 0.045, 0.048), (0.14, 0.135, 0.13)),
    "stone": ((0.16, 0.15, 0.14), (0.38, 0.36, 0.33)),
    "snow": ((0.55, 0.58, 0.64), (0.84, 0.86, 0.90)),
}
"""Name -> linear albedos of its dark and its bright parts, orders of magnitude as in tables of albedo."""


class Ground(Spec):
    """Plain of albedos between ``dark`` and ``bright`` (linear), in patches of ``patch`` eye heights."""

    dark: Triple
    bright: Triple
    patch: Number
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator, kinds: tuple[str, ...] = tuple(KINDS)) -> Self:
        """One of the kinds, a little lighter or darker."""
        dark, bright = KINDS[kinds[int(rng.integers(len(kinds)))]]
        share = rng.uniform(0.8, 1.15) * (1.0 + rng.uniform(-0.12, 0.12, 3))
        return cls(
            dark=tuple(share * dark),
            bright=tuple(share * bright),
            patch=between(rng, 1.0, 8.0),
            seed=int(rng.integers(2**31)),
        )

    def mean(self) -> np.ndarray:
        """(3,) mean albedo."""
        return 0.5 * (np.asarray(self.dark) + np.asarray(self.bright))

    def albedo(self, directions: np.ndarray) -> np.ndarray:
        """Linear albedo (N, 3) of the ground in directions (N, 3) with z < 0."""
        points, _ = on_ground(directions)
        broad = Fractal(self.seed, "patches")(points / self.patch, 5)
        fine = Fractal(self.seed, "grain")(points * 4.0, 5, 0.8)
        mixed = 0.5 + 0.5 * np.tanh(3.0 * (broad - 0.5) + 6.0 * (fine - 0.5))
        shaded = 1.0 - 0.55 * smoothstep(fine, 0.56, 0.64) * smoothstep(broad, 0.4, 0.6)
        spread = np.asarray(self.bright) - np.asarray(self.dark)
        return (np.asarray(self.dark) + mixed[:, None] * spread) * shaded[:, None]


def on_ground(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) of the ground and their distances (N,), in eye heights, in directions (N, 3), z < 0."""
    distance = 1.0 / np.maximum(-directions[:, 2], 1e-3)
    return directions[:, :2] * distance[:, None], distance


EARTH = 60.0
"""Radius of the earth in heights of the clouds; less than the true one: clouds meet the horizon sooner."""

HAZE = 9.0
"""Distance, in heights of the clouds, over which the air hides a share of 1 - 1/e of them."""

FORWARD = 0.75
"""Asymmetry g of the scattering by droplets, as seen around the sun."""

DIFFUSION = 0.15
"""1 - g of the light that comes out diffuse below."""

SIDES = 0.6
"""Share of the light that goes back which leaves by the sides that we see."""

WISP_STRETCH = 5.0
"""Length of high clouds over their width."""

_CIRRUS_DEPTH = 0.9
_LIT_STEPS = (0.18, 0.45)


class Weather(Spec):
    """Sun, air and clouds. Angles in degrees, azimuth from +x towards +y.

    Attributes:
        turbidity: of the air, 1 to 10.
        aperture_deg: diameter of the sun, which keeps its power.
        cover: share of the sky under low clouds.
        size: of the largest clouds, in heights of their base.
        depth: optical depth of low clouds where they are thickest.
        edge: width of a cloud's rim in values of its noise: small for heaps, wide for veils.
        wisps: share of the sky under thin high clouds.
        seed: of their shapes.
    """

    azimuth_deg: Number
    elevation_deg: Number
    turbidity: Number
    aperture_deg: Number
    cover: Number
    size: Number
    depth: Number
    edge: Number
    wisps: Number
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Self:
        """From a red sun at the horizon to noon, from a clear sky to a closed one."""
        low = rng.random() < 0.35
        return cls(
            azimuth_deg=rng.uniform(0.0, 360.0),
            elevation_deg=rng.uniform(2.5, 16.0) if low else rng.uniform(16.0, 75.0),
            turbidity=rng.uniform(2.0, 6.0),
            aperture_deg=between(rng, 0.7, 3.0),
            cover=rng.uniform(0.1, 1.0),
            size=between(rng, 0.5, 2.5),
            depth=between(rng, 2.0, 30.0),
            edge=rng.uniform(0.06, 0.3),
            wisps=rng.uniform(0.0, 0.8),
            seed=int(rng.integers(2**31)),
        )

    @property
    def toward(self) -> np.ndarray:
        """Unit direction (3,) to the sun."""
        return direction(self.azimuth_deg, self.elevation_deg)


class Above:
    """Sky of a weather, prepared.

    Attributes:
        sunlight: (3,) linear irradiance on a plane that faces the sun, before the clouds.
        sunlight_below: (3,) the same under the clouds.
        skylight: (3,) irradiance on a level plane from all of the sky but the sun.
    """

    def __init__(self, weather: Weather, ground_albedo: float) -> None:
        self.weather = weather
        self._sky = Sky(weather.toward, weather.turbidity, ground_albedo)
        self._low, self._high = Fractal(weather.seed, "low"), Fractal(weather.seed, "high")
        self._low_from = self._low.threshold(weather.cover)
        self._high_from = self._high.threshold(weather.wisps)
        self.sunlight = self._sunlight()
        low, high = self._depths(_around(weather.toward, weather.aperture_deg))
        self.sunlight_below = self.sunlight * float(np.exp(-(low + high)).mean())
        level = _level_directions(1024)
        self._ambient = self._sky.dome(level).mean(axis=0)
        self.skylight = np.pi * self.radiance(level).mean(axis=0)

    @cached_property
    def disc(self) -> Disc:
        """The sun, as far as it comes through the clouds."""
        return Disc(self.weather.toward, self.weather.aperture_deg, self.sunlight_below)

    @cached_property
    def _horizon(self) -> np.ndarray:
        around = [direction(azimuth, 2.0) for azimuth in np.arange(0.0, 360.0, 4.0)]
        ring = self.radiance(np.stack(around))
        # The glow around a low sun lies beyond the haze, not in it.
        ring = np.minimum(ring, 3.0 * self.skylight / np.pi)
        return np.concatenate([ring, ring[:1]])

    def horizon(self, directions: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) of the sky just above the horizon under or over directions (N, 3)."""
        place = np.degrees(np.arctan2(directions[:, 1], directions[:, 0])) % 360.0 / 4.0
        at = np.arange(len(self._horizon))
        return np.stack([np.interp(place, at, channel) for channel in self._horizon.T], axis=1)

    def level_irradiance(self) -> np.ndarray:
        """(3,) irradiance on open level ground."""
        return self.skylight + self.sunlight_below * self.weather.toward[2]

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) of air and clouds, without the sun's disc, in directions (N, 3), z > 0."""
        w = self.weather
        # The model is black at the horizon itself.
        raised = directions * (1.0, 1.0, 0.0) + np.maximum(directions[:, 2:], 0.01) * (0.0, 0.0, 1.0)
        raised /= np.linalg.norm(raised, axis=1, keepdims=True)
        air = self._sky.dome(raised)
        distance = _distance(raised[:, 2])
        plane = raised[:, :2] * distance[:, None]
        cosine = np.clip(raised @ w.toward, -1.0, 1.0)
        phase = _henyey_greenstein(cosine, FORWARD)[:, None]
        seen = np.exp(-distance / HAZE)[:, None]

        thin = self._high_depth(plane)
        veil = -np.expm1(-thin)[:, None]
        high_light = self.sunlight * (phase + 0.06) + self._ambient * 0.6
        behind = air + (high_light - 0.5 * air) * veil * seen

        depth = self._low_depth(plane, 6)
        if not depth.any():
            return np.maximum(behind, 0.0)
        step = w.size * w.toward[:2] / max(float(np.hypot(*w.toward[:2])), 1e-6)
        above = sum(self._low_depth(plane + reach * step, 4) for reach in _LIT_STEPS) / len(_LIT_STEPS)
        # A low sun shines through more of its own clouds and onto more of their sides.
        lit = 1.0 / (1.0 + 0.35 * np.asarray(above))[:, None]
        diffuse = 1.0 / (1.0 + DIFFUSION * depth)[:, None]
        side = SIDES * (1.0 - diffuse) * (0.5 - 0.5 * cosine)[:, None] * lit
        below = self.sunlight / np.pi * (w.toward[2] * diffuse * (0.35 + 0.65 * lit) + side)
        forward = self.sunlight * phase * np.exp(-0.7 * depth)[:, None] * lit
        bounced = 0.25 * self._ambient
        cloud = below + forward + self._ambient * (0.35 + 0.65 * diffuse) + bounced
        opaque = -np.expm1(-depth * 1.5)[:, None]
        there = behind * (1.0 - opaque) + cloud * opaque
        return np.maximum(behind + (there - behind) * seen, 0.0)

    def _sunlight(self) -> np.ndarray:
        """Irradiance of the disc on a plane that faces it: the mean radiance times the solid angle."""
        width = 2.0
        inside = _around(self.weather.toward, width)
        cap = 2.0 * np.pi * (1.0 - np.cos(np.radians(0.5 * width)))
        return self._sky.disc(inside, width).mean(axis=0) * cap

    def _depths(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distance = _distance(directions[:, 2])
        plane = directions[:, :2] * distance[:, None]
        slant = np.minimum(distance, 4.0)
        return self._low_depth(plane, 6) * slant, self._high_depth(plane) * slant

    def _low_depth(self, plane: np.ndarray, octaves: int) -> np.ndarray:
        w = self.weather
        value = self._low(plane / w.size, octaves)
        rim = smoothstep(value, self._low_from, self._low_from + w.edge)
        return w.depth * rim * (0.1 + (np.maximum(value - self._low_from, 0.0) / 0.25) ** 2)

    def _high_depth(self, plane: np.ndarray) -> np.ndarray:
        turn = direction(37.0 + self.weather.seed % 360, 0.0)[:2]
        along, across = plane @ turn, plane @ (-turn[1], turn[0])
        stretched = np.stack([along / WISP_STRETCH, across], axis=1) * 0.9
        value = self._high(stretched, 6, 0.6)
        return _CIRRUS_DEPTH * np.clip((value - self._high_from) / 0.25, 0.0, 1.0)


def _distance(z: np.ndarray) -> np.ndarray:
    """Distance to the shell one unit above the ground along directions of height ``z``."""
    return np.sqrt((EARTH * z) ** 2 + 2.0 * EARTH + 1.0) - EARTH * z


def _henyey_greenstein(cosine: np.ndarray, g: float) -> np.ndarray:
    return (1.0 - g * g) / (4.0 * np.pi * (1.0 + g * g - 2.0 * g * cosine) ** 1.5)


def _level_directions(count: int) -> np.ndarray:
    """Directions (count, 3) spread over the upper hemisphere by the cosine: their mean is irradiance / pi."""
    k = np.arange(count) + 0.5
    radius, angle = np.sqrt(k / count), k * np.pi * (3.0 - np.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - k / count)], axis=1)


def _around(centre: np.ndarray, width_deg: float) -> np.ndarray:
    """Directions (64, 3) spread evenly over a disc; those below the horizon are left out."""
    across = np.cross(centre, (0.0, 0.0, 1.0))
    across /= np.linalg.norm(across)
    up = np.cross(across, centre)
    k = np.arange(64) + 0.5
    radius = np.sin(np.radians(0.5 * width_deg)) * np.sqrt(k / 64) * 0.999
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    offset = (
        np.outer(radius * np.cos(angle), across)
        + np.outer(radius * np.sin(angle), up)
        + np.outer(np.sqrt(1 - radius**2), centre)
    )
    return offset[offset[:, 2] > 0.002]
