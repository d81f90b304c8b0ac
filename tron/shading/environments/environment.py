"""The environment map: radiance from every direction, at rest (NumPy) and as a light (Dr.Jit).

One convention, that of Mitsuba's ``envmap`` plugin turned z-up by ``rotate([1, 0, 0], 90)``. For a unit world
direction d, before the map's own rotation about +z:

    u = atan2(d.x, d.y) / (2 pi)  (mod 1),      v = acos(d.z) / pi

so the top row is the zenith, the left edge looks along +y and the middle column along -y. Columns are centred
on half texels (column j at u = (j + 1/2) / W, periodic), rows stand *on* the poles (row i at v = i/(H - 1)).
Between those samples radiance is bilinear in (u, v), and every integral below is of that bilinear function.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.color import luminance
from tron.errors import TronError
from tron.io.images import write_image
from tron.io.lat_long import directions, resampled, row_integrals
from tron.io.lights import read_light
from tron.runtime import aligned

PDF_WIDTH = 512
"""Widest grid, in cells, that directions are drawn from: finer maps are averaged down to it."""

PDF_FLOOR = 0.01
"""Least density of a cell, relative to the mean: no direction is impossible, so lookups stay unbiased."""

_ROWS = 64  # of the map for summing a plane's light: more are slower, fewer blur grazing light


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """Radiance arriving from every direction, as a lat-long image and a rotation.

    Attributes:
        image: (H, W, 3) float32, W = 2H, linear radiance (BT.709 primaries), finite and not negative.
        rotation_deg: turns the whole environment about world +z, counter-clockwise seen from above.

    Raises:
        TronError: the image has another shape, or holds NaN, infinity or negative values.
    """

    image: np.ndarray
    rotation_deg: float = 0.0

    def __post_init__(self) -> None:
        image = np.ascontiguousarray(self.image, np.float32)
        object.__setattr__(self, "image", image)
        _check(image, None)
        if not np.isfinite(self.rotation_deg):
            raise TronError(
                f"environment rotation is {self.rotation_deg}", mend="give a finite number of degrees"
            )

    @classmethod
    def load(cls, path: str | Path, rotation_deg: float = 0.0) -> EnvironmentMap:
        """Read a lat-long picture of light; :func:`read_light` lists the defects that are repaired.

        Raises:
            TronError: missing or unreadable file, another suffix, or an image that is no environment map.
        """
        image = read_light(Path(path))
        _check(image, str(path))
        return cls(image, rotation_deg)

    @classmethod
    def constant(cls, rgb: Any, height: int = 16) -> EnvironmentMap:
        """The same radiance ``rgb`` (scalar or (3,), linear) from everywhere."""
        return cls(np.broadcast_to(np.asarray(rgb, np.float32), (height, 2 * height, 3)))

    def save(self, path: str | Path, half: bool = False) -> None:
        """Write a lat-long .exr (float32 unless ``half``) or .hdr. A file has no rotation, so it is baked in.

        A rotation by a whole number of columns is exact; any other is interpolated between two columns.
        """
        write_image(path, self.baked().image, half=half)

    def baked(self) -> EnvironmentMap:
        """The same light with its rotation moved into the image."""
        if self.rotation_deg == 0.0:
            return self
        shift = self.rotation_deg / 360 * self.image.shape[1]
        whole = int(np.floor(shift))
        part = np.float32(shift - whole)
        image = np.roll(self.image, -whole, axis=1)
        if part > 1e-6:
            image = (1 - part) * image + part * np.roll(self.image, -whole - 1, axis=1)
        return EnvironmentMap(image)

    def rotated(self, degrees: float) -> EnvironmentMap:
        """The same map turned by another ``degrees`` about +z (counter-clockwise seen from above)."""
        return replace(self, rotation_deg=(self.rotation_deg + degrees) % 360.0)

    def turned(self, turn: np.ndarray) -> EnvironmentMap:
        """The same light in a world turned by ``turn`` (3, 3): resampled, so slightly softer."""
        return EnvironmentMap(self.lookup(self.directions() @ np.asarray(turn, np.float64)))

    def resized(self, height: int, width: int | None = None) -> EnvironmentMap:
        """Area average over the new texels' solid angles; ``width`` is 2 ``height`` if not given.

        The average is that of the bilinear function, with rows standing on the poles before and after, so
        lights do not move and a constant stays constant.
        """
        width = 2 * height if width is None else width
        if (height, width) == self.image.shape[:2]:
            return self
        return replace(self, image=resampled(self.image, height, width))

    def lookup(self, directions: np.ndarray) -> np.ndarray:
        """Radiance (..., 3) float32 from unit world ``directions`` (..., 3), as Mitsuba's plugin gives it."""
        d = np.asarray(directions, np.float64)
        height, width = self.image.shape[:2]
        u = np.arctan2(d[..., 0], d[..., 1]) / (2 * np.pi) + self.rotation_deg / 360
        x = (u % 1.0) * width - 0.5
        y = np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2]) / np.pi * (height - 1)
        x0, y0 = np.floor(x), np.clip(np.floor(y), 0, height - 2)
        fx, fy = (x - x0)[..., None], (y - y0)[..., None]
        left, top = x0.astype(int) % width, y0.astype(int)
        right = (left + 1) % width
        upper = (1 - fx) * self.image[top, left] + fx * self.image[top, right]
        lower = (1 - fx) * self.image[top + 1, left] + fx * self.image[top + 1, right]
        return ((1 - fy) * upper + fy * lower).astype(np.float32)

    def to_mitsuba(self) -> dict:
        """Description of this light for ``mi.load_dict`` (``type='envmap'``), rotation included."""
        to_world = mi.ScalarTransform4f().rotate([0, 0, 1], self.rotation_deg).rotate([1, 0, 0], 90)
        return {"type": "envmap", "bitmap": mi.Bitmap(self.image), "to_world": to_world}

    def solid_angles(self) -> np.ndarray:
        """(H,) float64: integral over the sphere of one texel's bilinear weight; W times the sum is 4 pi."""
        return row_integrals(self.image.shape[0], np.sin) * (2 * np.pi / self.image.shape[1])

    def directions(self) -> np.ndarray:
        """(H, W, 3) float64 unit directions that the samples of the image come from, before the rotation."""
        return directions(*self.image.shape[:2])

    def mean(self) -> np.ndarray:
        """(3,) float64: mean radiance over the sphere."""
        weights = self.solid_angles() / (4 * np.pi)
        return np.einsum("i,ijc->c", weights, self.image, dtype=np.float64)

    def contrast(self) -> float:
        """Share of all light that comes from the brightest hundredth of the sphere.

        0.01 for a constant, near 1 for a sun, 0 for a black map; light is luminance times solid angle.
        """
        energy = np.asarray(luminance(self.image), np.float64)
        area = np.repeat(self.solid_angles(), self.image.shape[1]) / (4 * np.pi)
        order = np.argsort(-energy.ravel(), kind="stable")
        area, energy = area[order], energy.ravel()[order] * area[order]
        covered = np.cumsum(area)
        share = np.clip(1 - (covered - 0.01) / area, 0, 1)
        return float((energy * share).sum() / max(energy.sum(), 1e-300)) if energy.sum() > 0 else 0.0

    def unoccluded_upward(self) -> np.ndarray:
        """(3,) float64: radiance of a white diffuse plane facing +z with nothing in the way, E / pi."""
        weights = row_integrals(self.image.shape[0], lambda t: np.maximum(np.cos(t), 0) * np.sin(t))
        weights *= 2 / self.image.shape[1]
        return np.einsum("i,ijc->c", weights, self.image, dtype=np.float64)

    def unoccluded(self, normal: np.ndarray) -> np.ndarray:
        """(3,) float64: radiance of a white diffuse plane with nothing in the way, E / pi.

        Args:
            normal: (3,) unit, world.
        """
        light = self.baked().resized(min(_ROWS, self.image.shape[0]))
        facing = np.maximum(light.directions() @ np.asarray(normal, np.float64), 0) / np.pi
        return np.einsum("i,ij,ijc->c", light.solid_angles(), facing, light.image, dtype=np.float64)

    def exposure(self) -> float:
        """The one scalar that every buffer under this light is multiplied by before AgX.

        0.4 over the luminance of :meth:`unoccluded_upward`, in inverse radiance.

        Raises:
            TronError: no light falls on an upward plane, so no exposure shows anything.
        """
        light = float(luminance(self.unoccluded_upward()))
        if light <= 0:
            raise TronError(
                "the environment map lights nothing from above", mend="give a map that is not black"
            )
        return 0.4 / light


class EnvironmentLight:
    """An :class:`EnvironmentMap` on the device: radiance, importance sampling, and its density.

    Directions are drawn from a grid of cells whose corners are texel centres. A cell's probability is
    proportional to its mean bilinear luminance times its solid angle, floored at ``PDF_FLOOR`` of the mean;
    inside a cell the density is uniform in solid angle. Maps wider than ``pdf_width`` are averaged for the
    grid, never for radiance.
    """

    def __init__(self, environment: EnvironmentMap, pdf_width: int = PDF_WIDTH) -> None:
        self.environment = environment
        image = environment.image
        height, width = image.shape[:2]
        # Opaque numbers: lights of all sizes and rotations must share one compiled kernel.
        self._width, self._last_row = dr.opaque(mi.Int, width), dr.opaque(mi.Int, height - 1)
        rgba = np.concatenate([image, np.zeros_like(image[..., :1])], axis=-1)
        self._texels = mi.Float(aligned(rgba.ravel()))
        self._rotation = dr.opaque(mi.Float, environment.rotation_deg / 360)

        coarse = environment if width <= pdf_width else environment.resized(pdf_width // 2, pdf_width)
        y = np.asarray(luminance(coarse.image), np.float64)
        y = 0.5 * (y + np.roll(y, -1, axis=1))
        y = 0.5 * (y[1:] + y[:-1])
        rows, columns = y.shape
        self._rows, self._columns = dr.opaque(mi.Int, rows), dr.opaque(mi.Int, columns)
        angle = np.linspace(0, np.pi, rows + 1)
        area = -np.diff(np.cos(angle))[:, None] * (2 * np.pi / columns)
        mean = (y * area).sum() / (4 * np.pi)
        mass = np.maximum(y, PDF_FLOOR * mean if mean > 0 else 1.0) * area
        mass /= mass.sum()
        self._density = mi.Float(aligned((mass / area).astype(np.float32).ravel()))
        self._distribution = mi.DiscreteDistribution2D(mass.astype(np.float32))

    def turned_to(self, rotation_deg: float) -> EnvironmentLight:
        """The same map at another rotation. Texels and densities are shared, so this costs nothing."""
        other = copy(self)
        other.environment = replace(self.environment, rotation_deg=rotation_deg)
        other._rotation = dr.opaque(mi.Float, rotation_deg / 360)
        return other

    @property
    def face_resolution(self) -> int:
        """Texels along a quarter of the horizon."""
        return self.environment.image.shape[1] // 4

    def _longitude(self, d: mi.Vector3f) -> mi.Float:
        u = dr.atan2(d.x, d.y) * float(0.5 / np.pi) + self._rotation
        return u - dr.floor(u)

    def radiance(self, d: mi.Vector3f) -> mi.Color3f:
        """Bilinear lookup: linear radiance arriving from unit world directions ``d``."""
        width = self._width
        x = self._longitude(d) * mi.Float(width) - 0.5
        y = _polar_angle(d) * (mi.Float(self._last_row) * float(1 / np.pi))
        left, top = mi.Int(dr.floor(x)), mi.Int(y)
        top = dr.select(top < self._last_row, top, self._last_row - 1)
        fx, fy = x - mi.Float(left), y - mi.Float(top)
        left = dr.select(left < 0, left + width, left)
        right = dr.select(left + 1 >= width, 0, left + 1)
        top *= width

        def texel(index: mi.Int) -> mi.Vector4f:
            return dr.gather(mi.Vector4f, self._texels, mi.UInt32(index))

        upper = dr.lerp(texel(top + left), texel(top + right), fx)
        lower = dr.lerp(texel(top + width + left), texel(top + width + right), fx)
        value = dr.lerp(upper, lower, fy)
        return mi.Color3f(value.x, value.y, value.z)

    def sample(self, u: mi.Point2f, active: Any = True) -> tuple[mi.Vector3f, mi.Float]:
        """Unit world directions and their densities (per steradian) from uniform ``u`` in [0, 1)^2."""
        cell, _, inside = self._distribution.sample(u, active)
        column, row = mi.Float(cell.x), mi.Float(cell.y)
        step = float(np.pi) / mi.Float(self._rows)
        upper, lower = dr.cos(row * step), dr.cos((row + 1) * step)
        z = dr.clip(dr.lerp(upper, lower, inside.y), -1, 1)
        # Cells begin at texel centres, half a texel into the image.
        longitude = (column + 0.5 + inside.x) / mi.Float(self._columns) - self._rotation
        sin, cos = dr.sincos(float(2 * np.pi) * longitude)
        radius = dr.safe_sqrt(1 - z * z)
        density = dr.gather(mi.Float, self._density, cell.y * mi.UInt32(self._columns) + cell.x, active)
        return mi.Vector3f(radius * sin, radius * cos, z), density

    def pdf(self, d: mi.Vector3f) -> mi.Float:
        """Density (per steradian) with which :meth:`sample` draws unit world directions ``d``."""
        column = mi.Int(dr.floor(self._longitude(d) * mi.Float(self._columns) - 0.5))
        column = dr.select(column < 0, column + self._columns, column)
        row = mi.Int(_polar_angle(d) * (mi.Float(self._rows) * float(1 / np.pi)))
        row = dr.select(row < self._rows, row, self._rows - 1)
        return dr.gather(mi.Float, self._density, mi.UInt32(row * self._columns + column))


def _polar_angle(d: mi.Vector3f) -> mi.Float:
    # acos(d.z) loses half its digits at the poles; atan2 does not.
    return mi.Float(dr.atan2(dr.sqrt(d.x * d.x + d.y * d.y), d.z))


def _check(image: np.ndarray, where: str | None) -> None:
    if image.ndim != 3 or image.shape[2] != 3:
        raise TronError(f"environment map has shape {image.shape}", where, "give an RGB image (H, W, 3)")
    height, width = image.shape[:2]
    if width != 2 * height or height < 4:
        raise TronError(
            f"environment map is {width} x {height} pixels, not 2:1",
            where,
            "give a lat-long image, twice as wide as high",
        )
    if not np.isfinite(image).all():
        raise TronError(
            "environment map holds NaN or infinity", where, "repair the file: radiance must be finite"
        )
    if image.min() < 0:
        raise TronError(
            f"environment map holds negative radiance (down to {image.min():.3g})",
            where,
            "clamp it to zero or above",
        )
