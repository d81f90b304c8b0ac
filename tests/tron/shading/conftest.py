"""A scene in closed form: a white sphere above a plane, traced exactly; the witness of every shadow test."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.cameras import Camera
from tron.shading.environments.cubemap import CubemapLight, texel_directions
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing import GBuffer, Surface
from tron.tracing.hierarchy.transmittance import Fans

CENTRE, RADIUS = np.array([0.0, 0.0, 0.8]), 0.5


class SphereOverPlane:
    """The plane z = 0 within |x|, |y| < 3 and a sphere floating above it; answers as a SurfelTracer does."""

    def __init__(self, sphere: bool = True, base_color: float = 1.0, metallic: float = 0.0) -> None:
        self.sphere, self.base_color, self.metallic = sphere, base_color, metallic
        self.scene = SimpleNamespace(spacing=0.02)

    def sided(self, two_sided: bool) -> SphereOverPlane:
        return self

    def _sphere_hit(self, origin: mi.Point3f, direction: mi.Vector3f) -> mi.Float:
        """Distance to the sphere, infinite if missed."""
        to = mi.Vector3f(origin) - mi.Vector3f(*map(float, CENTRE))
        b, c = dr.dot(to, direction), dr.squared_norm(to) - RADIUS**2
        under = b * b - c
        t = -b - dr.safe_sqrt(under)
        return dr.select((under > 0) & (t > 0) & self.sphere, t, dr.inf)

    def transmittances(self, fans: Fans) -> list[mi.Float]:
        rays = zip(fans.directions, fans.active)
        hits = [lanes & dr.isfinite(self._sphere_hit(fans.origin, d)) for d, lanes in rays]
        return [dr.select(hit, mi.Float(0), 1) for hit in hits]

    def gbuffer(self, camera: Camera) -> GBuffer:
        n = camera.width * camera.height
        direction = mi.Vector3f(np.ascontiguousarray(camera.rays().reshape(n, 3).T))
        origin = mi.Point3f(*map(float, camera.position)) + dr.zeros(mi.Vector3f, n)
        sphere = self._sphere_hit(origin, direction)
        plane = dr.select(direction.z < 0, -origin.z / direction.z, dr.inf)
        on_plane = origin + direction * plane
        plane = dr.select((dr.abs(on_plane.x) < 3) & (dr.abs(on_plane.y) < 3), plane, dr.inf)
        t = dr.minimum(sphere, plane)
        seen = dr.isfinite(t)
        position = dr.select(seen, origin + direction * t, mi.Point3f(0))
        centre = mi.Point3f(*map(float, CENTRE))
        normal = dr.select(sphere < plane, dr.normalize(position - centre), mi.Vector3f(0, 0, 1))
        one = dr.select(seen, mi.Float(1), 0)
        seen = Surface(
            position=position,
            depth=dr.select(seen, t, 0),
            lift=mi.Float(0),
            normal=mi.Normal3f(dr.select(seen, normal, 0)),
            normal_sum=mi.Normal3f(dr.select(seen, normal, 0)),
            base_color=mi.Color3f(self.base_color) * one,
            roughness=0.5 * one,
            metallic=self.metallic * one,
            rgb=mi.Color3f(0) * one,
            opacity=one,
            direction=direction,
            values=[],
        )
        return GBuffer.of_rows(seen, camera.width, camera.height)


@pytest.fixture
def sphere_over_plane() -> type[SphereOverPlane]:
    return SphereOverPlane


@pytest.fixture
def camera() -> Camera:
    return Camera.look_at((3.0, -4.0, 3.0), (0, 0, 0.5), fov_deg=40, width=48, height=48)


@pytest.fixture
def sun_map() -> EnvironmentMap:
    """A sun of about six degrees, 55 degrees above the horizon, in a dim sky with a dark ground."""
    image = np.full((64, 128, 3), 0.3, np.float32)
    image[33:] = 0.1
    image[11:13, 30:32] = (1500.0, 1300.0, 1000.0)
    return EnvironmentMap(image)


@pytest.fixture
def cubemap_of(variant: str) -> Callable[[EnvironmentMap, int], CubemapLight]:
    """A map as a cubemap whose texels are means over 8 x 8 of its values."""

    def make(environment: EnvironmentMap, resolution: int) -> CubemapLight:
        directions = np.array(texel_directions(8 * resolution)).T
        fine = environment.lookup(directions).reshape(6, resolution, 8, resolution, 8, 3)
        return CubemapLight(mi.Float(fine.mean((2, 4)).ravel()), resolution)

    return make


class PointsGBuffer(GBuffer):
    """Points row by row instead of tile by tile; tests may arrange them in another width and height."""

    @property
    def pixel(self) -> mi.UInt32:
        return dr.arange(mi.UInt32, dr.width(self.opacity))


@pytest.fixture
def points_gbuffer(variant: str) -> Callable[[np.ndarray, np.ndarray], PointsGBuffer]:
    """Make an opaque, black G-buffer of positions and unit normals (N, 3)."""

    def make(positions: np.ndarray, normals: np.ndarray) -> PointsGBuffer:
        columns = [np.ascontiguousarray(np.asarray(a, np.float32).T) for a in (positions, normals)]
        normal, none = mi.Normal3f(columns[1]), dr.zeros(mi.Float, len(positions))
        return PointsGBuffer(
            position=mi.Point3f(columns[0]),
            depth=none,
            lift=none,
            normal=normal,
            normal_sum=normal,
            base_color=mi.Color3f(none),
            roughness=none,
            metallic=none,
            rgb=mi.Color3f(none),
            opacity=none + 1,
            direction=mi.Vector3f(none),
            values=[],
            width=len(positions),
            height=1,
        )

    return make
