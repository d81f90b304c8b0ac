"""Light families: a drawn specification becomes one lat-long environment map.

A family is one subclass of :class:`Light`, named in FAMILIES: what a recipe may ask for, what specifications
are read as and what clips say of their light follow from that table.

The same image lights Mitsuba's path tracer and the surfels, so whatever the bake rounds off is rounded off in
both.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self, Union

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


class Light(Spec):
    """Light at infinity around the scene: the specification of one family, its distribution and its radiance.

    Attributes:
        family: name in recipes, specifications and clips: a Literal with its default.
        in_any: whether ``any`` draws the family where a recipe names none. True changes what seeds give.
    """

    family: str
    in_any: ClassVar[bool] = False

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[HdriSpec]) -> Light:
        """Draw a light; ``files`` are the user's maps, for the family that takes one of them."""
        raise NotImplementedError

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) that comes from unit directions (N, 3), world, z up."""
        raise NotImplementedError

    def bake(self, height: int, environments: Path | None = None) -> EnvironmentMap:  # noqa: ARG002
        """Make the environment map, ``height`` rows and twice as many columns, linear radiance.

        ``environments`` is the folder of the user's maps.
        """
        # Rows stand on the poles: half a texel more on either side is clipped back onto the sphere.
        fine = (np.arange(SUPERSAMPLES) + 0.5) / SUPERSAMPLES - 0.5
        v = np.clip((np.arange(height)[:, None] + fine) / (height - 1), 0.0, 1.0).ravel()
        u = ((np.arange(2 * height)[:, None] + 0.5 + fine) / (2 * height)).ravel()
        theta, phi = np.meshgrid(v * np.pi, u * 2 * np.pi, indexing="ij")
        directions = np.stack(
            [np.sin(theta) * np.sin(phi), np.sin(theta) * np.cos(phi), np.cos(theta)], axis=-1
        )
        image = self.radiance(directions.reshape(-1, 3))
        image = image.reshape(height, SUPERSAMPLES, 2 * height, SUPERSAMPLES, 3).mean(axis=(1, 3))
        return EnvironmentMap(image.astype(np.float32))


class SunSpec(Light):
    """Sun and sky after Hosek and Wilkie, as Mitsuba's ``sunsky`` has them.

    Angles in degrees, azimuth from +x towards +y; ``aperture_deg`` is the sun's diameter. The sun keeps its
    power when it grows: wider than the true 0.53 degrees, it fits the texels of a small map. ``ground`` is
    the linear albedo of the plain seen below the horizon.
    """

    in_any = True
    family: Literal["sun"] = "sun"
    azimuth_deg: Number
    elevation_deg: Number
    turbidity: Number
    aperture_deg: Number
    ground: Triple

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[HdriSpec]) -> Self:  # noqa: ARG003
        return cls(
            azimuth_deg=rng.uniform(0.0, 360.0),
            elevation_deg=np.degrees(np.arcsin(rng.uniform(0.3, 0.92))),
            turbidity=rng.uniform(2.0, 6.0),
            aperture_deg=rng.uniform(2.5, 5.0),
            ground=tuple(rng.uniform(0.08, 0.3) * (1.0 + rng.uniform(-0.3, 0.3, 3))),
        )

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        emitter = mi.load_dict(
            {
                "type": "sunsky",
                "sun_direction": _direction(self.azimuth_deg, self.elevation_deg).tolist(),
                "turbidity": float(self.turbidity),
                "albedo": float(np.mean(self.ground)),
                "sun_aperture": float(self.aperture_deg),
            }
        )
        upper = directions[:, 2] > 0.0
        si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
        si.wi = -mi.Vector3f(np.ascontiguousarray(directions.T, np.float32))
        sky = np.array(emitter.eval(si)).T.astype(np.float64)
        # The plugin is black below the horizon; what is really seen there is sunlit ground.
        z = directions[upper, 2:]
        mean = (np.sin(np.arccos(z)) * z * sky[upper]).sum(axis=0) / np.sin(np.arccos(z)).sum()
        ground = np.asarray(self.ground) * 2.0 * mean
        return np.where(upper[:, None], np.maximum(sky, 0.0), ground)


class Panel(Spec):
    """A soft box at infinity: centre direction, half sizes and edge softness in degrees, linear radiance."""

    azimuth_deg: Number
    elevation_deg: Number
    roll_deg: Number
    half_width_deg: Number
    half_height_deg: Number
    softness_deg: Number
    radiance: Triple


class StudioSpec(Light):
    """Soft boxes on a surround that fades from ``floor`` below to ``ceiling`` above (linear radiance)."""

    in_any = True
    family: Literal["studio"] = "studio"
    panels: tuple[Panel, ...]
    floor: Triple
    ceiling: Triple

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[HdriSpec]) -> Self:  # noqa: ARG003
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
        return cls(
            panels=tuple(panels),
            floor=tuple(ambient * rng.uniform(0.3, 1.0) * _tint(rng, 0.2)),
            ceiling=tuple(ambient * _tint(rng, 0.2)),
        )

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        up = 0.5 + 0.5 * directions[:, 2:]
        image = np.asarray(self.floor) * (1.0 - up) + np.asarray(self.ceiling) * up
        for panel in self.panels:
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


class OvercastSpec(Light):
    """A cloudy dome: zenith and horizon radiance, a broad brighter patch, and the ground below (all linear).

    The dome is linear in sin(elevation): the CIE overcast sky where the horizon is a third of the zenith.
    """

    in_any = True
    family: Literal["overcast"] = "overcast"
    zenith: Triple
    horizon: Triple
    ground: Triple
    patch_azimuth_deg: Number
    patch_elevation_deg: Number
    patch_width_deg: Number
    patch: Triple

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[HdriSpec]) -> Self:  # noqa: ARG003
        tint = _tint(rng, 0.15)
        return cls(
            zenith=tuple(rng.uniform(0.9, 1.1) * tint),
            horizon=tuple(rng.uniform(0.25, 0.9) * _tint(rng, 0.12)),
            ground=tuple(rng.uniform(0.05, 0.35) * _tint(rng, 0.25)),
            patch_azimuth_deg=rng.uniform(0.0, 360.0),
            patch_elevation_deg=rng.uniform(15.0, 80.0),
            patch_width_deg=rng.uniform(20.0, 50.0),
            patch=tuple(rng.uniform(0.0, 2.0) * _tint(rng, 0.2)),
        )

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        z = directions[:, 2:]
        share = np.maximum(z, 0.0)
        dome = np.asarray(self.horizon) * (1.0 - share) + np.asarray(self.zenith) * share
        centre = _direction(self.patch_azimuth_deg, self.patch_elevation_deg)
        angle = np.degrees(np.arccos(np.clip(directions @ centre, -1.0, 1.0)))
        dome = dome + np.exp(-0.5 * (angle / self.patch_width_deg) ** 2)[:, None] * np.asarray(self.patch)
        above = _edge(np.degrees(np.arcsin(np.clip(z, -1.0, 1.0))), 4.0)
        return dome * above + np.asarray(self.ground) * (1.0 - above)


class HdriSpec(Light):
    """File of the user's, turned about z: its path within the environments folder, its hash, its contrast."""

    family: Literal["hdri"] = "hdri"
    path: str
    sha256: str
    rotation_deg: Number
    contrast: Literal["high", "low"]

    @classmethod
    def draw(cls, rng: np.random.Generator, files: Sequence[HdriSpec]) -> HdriSpec:
        """One of the user's maps, turned."""
        chosen = files[int(rng.integers(len(files)))]
        return chosen.model_copy(update={"rotation_deg": round(float(rng.uniform(0.0, 360.0)), 6)})

    def bake(self, height: int, environments: Path | None = None) -> EnvironmentMap:
        """Read the file's map, averaged down where it has more rows, never up.

        Raises:
            TronError: the file is missing or no environment map.
        """
        environment = EnvironmentMap.load(f"{environments}/{self.path}", self.rotation_deg)
        return environment if environment.image.shape[0] <= height else environment.resized(height)


FAMILIES: dict[str, type[Light]] = {
    str(light.model_fields["family"].default): light
    for light in (SunSpec, StudioSpec, OvercastSpec, HdriSpec)
}
"""Name -> family, in the order in which ``any`` numbers them: new ones come last."""

PROCEDURAL = tuple(name for name, light in FAMILIES.items() if light.in_any)
"""Families that ``any`` chooses from, unless a recipe names others."""

if TYPE_CHECKING:
    LightSpec = Light
    Family = LightChoice = str
else:
    LightSpec = Annotated[Union[tuple(FAMILIES.values())], Field(discriminator="family")]  # noqa: UP007
    Family = Literal[tuple(FAMILIES)]
    LightChoice = Literal["any", *FAMILIES]


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


def _edge(distance_deg: np.ndarray, softness_deg: float) -> np.ndarray:
    """Smoothstep from 0 at -softness to 1 at +softness."""
    t = np.clip(distance_deg / (2.0 * softness_deg) + 0.5, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
