"""The benchmark's scene: surfels, a mesh of the same surfaces for Mitsuba, camera and lights.

A floor, three spheres, a torus and a box. Surfels stand evenly by area along Roberts' R2 sequence (2018, "The
Unreasonable Effectiveness of Quasirandom Sequences"), slightly off the surface and slightly tilted, as in a
reconstruction; the floor, which fills much of the view, has half its share. Scales are set so that the summed
area of the three-sigma disks covers the surface OVERLAP times: some 33 candidates per ray.

Every surface is a closed form on the unit square whose map preserves area, so even points stay even.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import logit

from tron import seeds
from tron.cameras import Camera
from tron.gaussians.harmonics import SH_COUNT, rgb_to_dc
from tron.gaussians.scene import GaussianScene, measure_spacing, quats_from_matrices
from tron.shading.environments.environment import EnvironmentMap

OVERLAP, ANISOTROPY, TILT, LIFT = 15.0, 0.35, 0.12, 0.25
"""Summed area of the three-sigma disks over the surface's; deviations of the scales' natural logarithm, of
the normals in radians, and of the centres off the surface in sigmas."""
FLOOR_SHARE = 0.5
_PLASTIC = 1.32471795724474602596
"""The real root of x^3 = x + 1: the plane's golden ratio, on which R2 rests."""
MAP_HEIGHT = 128
"""Rows of the lights' maps."""


class Surface(abc.ABC):
    """A surface parametrised by (u, v) in [0, 1]^2; equal areas of the square stay equal in the world."""

    @property
    @abc.abstractmethod
    def area(self) -> float:
        """Area in world units squared."""

    @abc.abstractmethod
    def at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points and outward unit normals, two (N, 3) float64 arrays, world."""

    @abc.abstractmethod
    def patches(self, fineness: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return lattices (u, v), 1D each and ascending, whose quads cover the surface."""

    def mesh(self, fineness: int = 96) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return triangles: vertices (V, 3), vertex normals (V, 3), faces (F, 3) wound outwards."""
        vertices, normals, faces = [], [], []
        offset = 0
        for u, v in self.patches(fineness):
            grid_u, grid_v = (a.ravel() for a in np.meshgrid(u, v, indexing="ij"))
            points, directions = self.at(grid_u, grid_v)
            corner = np.arange(len(u) * len(v)).reshape(len(u), len(v)) + offset
            a, b, c, d = (
                q.ravel() for q in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:])
            )
            faces.append(np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
            vertices.append(points)
            normals.append(directions)
            offset += corner.size
        points, directions, triangles = map(np.concatenate, (vertices, normals, faces))
        return points, directions, _wound_outwards(points, directions, triangles)


def _wound_outwards(points: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Turn triangles whose winding disagrees with their vertex normals; drop those without an area."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    faces = np.where(((cross * normals[faces].sum(1)).sum(1) < 0)[:, None], faces[:, [0, 2, 1]], faces)
    return faces[np.linalg.norm(cross, axis=1) > 1e-12]


@dataclass(frozen=True)
class Floor(Surface):
    """The square |x|, |y| <= half in the plane z = 0, seen from above."""

    half: float

    @property
    def area(self) -> float:
        """Area in world units squared."""
        return 4 * self.half**2

    def at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and normals."""
        points = np.stack([(2 * u - 1) * self.half, (2 * v - 1) * self.half, np.zeros_like(u)], 1)
        return points, np.tile([0.0, 0.0, 1.0], (len(u), 1))

    def patches(self, fineness: int) -> list[tuple[np.ndarray, np.ndarray]]:  # noqa: ARG002 (flat)
        """One quad."""
        return [(np.array([0.0, 1.0]), np.array([0.0, 1.0]))]


@dataclass(frozen=True)
class Sphere(Surface):
    """A sphere; u is longitude, v runs evenly in height (Archimedes: that preserves area)."""

    centre: tuple[float, float, float]
    radius: float

    @property
    def area(self) -> float:
        """Area in world units squared."""
        return 4 * np.pi * self.radius**2

    def at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and normals."""
        z = 1 - 2 * v
        ring = np.sqrt(np.maximum(1 - z * z, 0))
        normals = np.stack([ring * np.cos(2 * np.pi * u), ring * np.sin(2 * np.pi * u), z], 1)
        return np.array(self.centre) + self.radius * normals, normals

    def patches(self, fineness: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return a lattice even in the polar angle, so that poles are as fine as the equator."""
        polar = np.linspace(0, np.pi, fineness // 2 + 1)
        return [(np.linspace(0, 1, fineness + 1), (1 - np.cos(polar)) / 2)]


@dataclass(frozen=True)
class Torus(Surface):
    """A lying torus; u runs around its axis, v around the tube at a pace that preserves area."""

    centre: tuple[float, float, float]
    major: float
    minor: float

    @property
    def area(self) -> float:
        """Area in world units squared."""
        return 4 * np.pi**2 * self.major * self.minor

    def _share(self, angle: np.ndarray) -> np.ndarray:
        """Return the share of the area below a tube angle: the integral of (R + r cos b) / (2 pi R)."""
        return (self.major * angle + self.minor * np.sin(angle)) / (2 * np.pi * self.major)

    def at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and normals."""
        table = np.linspace(0, 2 * np.pi, 8193)
        tube, around = np.interp(v, self._share(table), table), 2 * np.pi * u
        outwards = np.stack([np.cos(around), np.sin(around), np.zeros_like(u)], 1)
        normals = outwards * np.cos(tube)[:, None] + np.array([0, 0, 1.0]) * np.sin(tube)[:, None]
        return np.array(self.centre) + self.major * outwards + self.minor * normals, normals

    def patches(self, fineness: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return a lattice even in the tube angle."""
        return [(np.linspace(0, 1, fineness + 1), self._share(np.linspace(0, 2 * np.pi, fineness // 2 + 1)))]


@dataclass(frozen=True)
class Box(Surface):
    """A cube along the axes; u picks the face, and what is left of it a place along the face."""

    centre: tuple[float, float, float]
    half: float

    @property
    def area(self) -> float:
        """Area in world units squared."""
        return 24 * self.half**2

    def at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and normals."""
        face = np.minimum((u * 6).astype(int), 5)
        row, axis = np.arange(len(u)), face // 2
        normals = np.zeros((len(u), 3))
        normals[row, axis] = np.where(face % 2, 1.0, -1.0)
        points = normals.copy()
        points[row, (axis + 1) % 3] = 2 * (u * 6 - face) - 1
        points[row, (axis + 2) % 3] = 2 * v - 1
        return np.array(self.centre) + self.half * points, normals

    def patches(self, fineness: int) -> list[tuple[np.ndarray, np.ndarray]]:  # noqa: ARG002 (flat)
        """Return one quad per face; upper ends of faces stay slightly inside their strip of u."""
        return [(np.array([k, k + 1 - 1e-9]) / 6, np.array([0.0, 1.0])) for k in range(6)]


SURFACES: tuple[Surface, ...] = (
    Floor(3.0),
    Sphere((0.0, 0.0, 0.8), 0.8),
    Sphere((1.5, 0.8, 0.5), 0.5),
    Sphere((-0.9, -1.3, 0.4), 0.4),
    Torus((-1.4, 0.6, 0.25), 0.6, 0.25),
    Box((0.9, -1.2, 0.45), 0.45),
)


def camera(size: int) -> Camera:
    """Return the camera of ``size`` x ``size`` pixels; a few at the top miss the floor."""
    return Camera.look_at((4.2, -3.6, 3.0), (0.0, 0.0, 0.35), fov_deg=27, width=size, height=size)


def surfels(count: int, seed: int, lift: float = LIFT) -> GaussianScene:
    """Draw ``count`` surfels of degree 2 on the surfaces, in random order; opacities are Beta(2.2, 0.6)."""
    rng = seeds.generator(seed, "tracing", "surfels", count, 2)
    areas = np.array([s.area for s in SURFACES])
    shares = areas * np.where(np.arange(len(SURFACES)) == 0, FLOOR_SHARE, 1.0)
    numbers = np.diff(np.round(np.cumsum(shares) / shares.sum() * count).astype(int), prepend=0)
    points, normals = [], []
    for surface, number in zip(SURFACES, numbers):
        u, v = r2_sequence(number, rng.random(2))
        p, n = surface.at(u, v)
        points.append(p)
        normals.append(n)
    means, outwards = np.concatenate(points), np.concatenate(normals)
    sigma = np.sqrt(OVERLAP * np.repeat(areas / np.maximum(numbers, 1), numbers) / np.pi) / 3
    tilted = outwards + TILT * rng.normal(size=outwards.shape)
    tangent_frame = _frames(tilted / np.linalg.norm(tilted, axis=1, keepdims=True), rng)
    scales = sigma[:, None] * np.exp(ANISOTROPY * rng.normal(size=(count, 2)))
    opacities = np.clip(rng.beta(2.2, 0.6, count), 0.02, 0.989)
    colors = 0.5 + 0.5 * np.sin(2.3 * means + np.array([0.0, 1.0, 2.0]))
    order = rng.permutation(count)
    lifted = means + outwards * (lift * sigma * rng.normal(size=count))[:, None]
    sh = np.zeros((count, SH_COUNT, 3))
    sh[:, 0] = rgb_to_dc(colors)
    return GaussianScene(
        means=lifted[order],
        quats=quats_from_matrices(tangent_frame)[order],
        log_scales=np.log(scales)[order],
        opacity_logits=logit(opacities)[order],
        sh=sh[order],
        base_color=colors[order],
        roughness=(0.5 + 0.4 * np.sin(3 * means[:, 0]))[order],
        metallic=(0.5 + 0.5 * np.sin(2 * means[:, 1]))[order],
        object_id=np.repeat(np.arange(len(SURFACES)), numbers)[order],
        kernel_degree=2,
        spacing=measure_spacing(lifted),
    ).validate()


def r2_sequence(count: int, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` points of the R2 sequence, shifted by ``shift`` (2,) modulo 1: two (count,) arrays."""
    steps = np.arange(1, count + 1)[:, None] / _PLASTIC ** np.array([1, 2])
    points = (steps + shift) % 1.0
    return points[:, 0], points[:, 1]


def _frames(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return rotations (M, 3, 3) with the normal as third column, turned about it at random."""
    other = np.where(np.abs(normals[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    a = np.cross(other, normals)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(normals, a)
    angle = rng.uniform(0, 2 * np.pi, (len(normals), 1))
    u, v = a * np.cos(angle) + b * np.sin(angle), b * np.cos(angle) - a * np.sin(angle)
    return np.stack([u, v, normals], -1)


def mitsuba_mesh() -> dict[str, Any]:
    """Return the surfaces as white diffuse triangle meshes: shapes for ``mi.load_dict``.

    The radiance of a white surface is irradiance / pi, which TRON's pass computes.
    """
    import mitsuba as mi

    white = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}})
    shapes = {}
    for k, surface in enumerate(SURFACES):
        points, normals, faces = surface.mesh()
        properties = mi.Properties()
        properties["bsdf"] = white
        mesh = mi.Mesh(f"surface{k}", len(points), len(faces), properties, has_vertex_normals=True)
        values = mi.traverse(mesh)
        values["vertex_positions"] = points.astype(np.float32).ravel()
        values["vertex_normals"] = normals.astype(np.float32).ravel()
        values["faces"] = faces.astype(np.uint32).ravel()
        values.update()
        shapes[f"surface{k}"] = mesh
    return shapes


def _angles() -> tuple[np.ndarray, np.ndarray]:
    """Return elevation and azimuth of every texel, radians."""
    elevation = np.pi / 2 - np.linspace(0, np.pi, MAP_HEIGHT)[:, None]
    azimuth = (np.arange(2 * MAP_HEIGHT) + 0.5)[None] / (2 * MAP_HEIGHT) * 2 * np.pi
    return elevation, azimuth


def _spot(elevation_deg: float, azimuth_deg: float, radius_deg: float, soft_deg: float) -> np.ndarray:
    """Return a disk of the sphere with a linear edge, (H, W) in [0, 1]."""
    elevation, azimuth = _angles()
    e, a = np.radians(elevation_deg), np.radians(azimuth_deg)
    cosine = np.sin(elevation) * np.sin(e) + np.cos(elevation) * np.cos(e) * np.cos(azimuth - a)
    away = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return np.clip((radius_deg + soft_deg - away) / soft_deg, 0, 1)


def _sky(zenith: float, horizon: float, ground: float) -> np.ndarray:
    elevation, _ = _angles()
    up = np.clip(np.sin(elevation), 0, 1)
    sky = horizon + (zenith - horizon) * up
    return np.where(elevation > 0, sky, ground) * np.ones((1, 2 * MAP_HEIGHT))


def sun() -> EnvironmentMap:
    """Return a sun of 2 degrees' radius, 40 degrees high; it gives four fifths of an upward plane's light."""
    sky = _sky(0.3, 0.5, 0.12)[..., None] * np.array([0.8, 0.9, 1.1])
    disk = _spot(40, 250, 2.0, 1.5)[..., None] * np.array([1.05, 1.0, 0.9])
    share = EnvironmentMap(disk).unoccluded_upward().mean() / EnvironmentMap(sky).unoccluded_upward().mean()
    return EnvironmentMap(sky + disk * (4.0 / share))


def soft() -> EnvironmentMap:
    """Return two wide windows in a dim room: penumbras everywhere."""
    room = _sky(0.25, 0.2, 0.1)[..., None] * np.ones(3)
    large = _spot(50, 220, 22, 10)[..., None] * np.array([1.0, 0.97, 0.9]) * 6
    small = _spot(25, 60, 14, 8)[..., None] * np.array([0.8, 0.9, 1.1]) * 4
    return EnvironmentMap(room + large + small)


LIGHTS = {"sun": sun, "soft": soft}
