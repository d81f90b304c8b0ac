"""The benchmark's scenes in two forms: surfels, and a mesh of the same surfaces for Mitsuba.

A floor, three spheres, a torus and a box, seen from outside; and the same things in a room and on a wide
ground, with the camera within. Surfels stand evenly by area along Roberts' R2 sequence (2018, "The
Unreasonable Effectiveness of Quasirandom Sequences"), a little off the surface and a little tilted, as a
reconstruction leaves them; floor or walls, of which a camera sees much, get half their share. Their scales
are set so that the summed area of their three-sigma disks covers the surface ``overlap`` times.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import logit

from eval.peers.surfaces import Box, Floor, Sphere, Surface, Torus
from tron import seeds
from tron.cameras import Camera
from tron.gaussians.harmonics import SH_COUNT, rgb_to_dc
from tron.gaussians.scene import GaussianScene, measure_spacing, neighbour_distances, quats_from_matrices

OBJECTS: tuple[Surface, ...] = (
    Sphere((0.0, 0.0, 0.8), 0.8),
    Sphere((1.5, 0.8, 0.5), 0.5),
    Sphere((-0.9, -1.3, 0.4), 0.4),
    Torus((-1.4, 0.6, 0.25), 0.6, 0.25),
    Box((0.9, -1.2, 0.45), 0.45),
)
FLOOR = Floor(3.0)
SURFACES: tuple[Surface, ...] = (FLOOR, *OBJECTS)
FLOOR_SHARE = 0.5
_PLASTIC = 1.32471795724474602596
"""The real root of x^3 = x + 1: the plane's golden ratio, on which R2 rests."""


@dataclass(frozen=True)
class Recipe:
    """Recipe of surfels on a surface.

    Attributes:
        name: in the names of metrics; empty for the usual one.
        degree: kernel degree.
        overlap: summed area of the three-sigma disks over the area of the surface.
        anisotropy: standard deviation of the scales' natural logarithm.
        tilt: standard deviation of the normals, radians.
        lift: standard deviation of the centres off the surface, in sigmas.
        sh_degree: degree of the radiance's harmonics.
        opacity: the same opacity for all, or None for a spread that favours opaque ones (Beta(2.2, 0.6)).
    """

    name: str = ""
    degree: int = 2
    overlap: float = 15.0
    anisotropy: float = 0.35
    tilt: float = 0.12
    lift: float = 0.25
    sh_degree: int = 0
    opacity: float | None = None


STUDY = Recipe()
"""Surfels as reconstructions give them, and as the design study had them: some 33 candidates a ray."""
FROM_GBUFFERS = Recipe("from_gbuffers", 4, overlap=0.0, anisotropy=0.0, tilt=0.01, lift=0.0, opacity=0.99)
"""As :func:`tron.gaussians.initialize.surfels_from_gbuffers` makes them: sigma is 0.4 neighbour distances."""


@dataclass(frozen=True)
class Place:
    """:data:`OBJECTS` on a floor or in a room, and a camera that sees them.

    Attributes:
        name: in the names of metrics; empty for the usual one.
        floor: what they stand on, or in.
        eye: centre of the camera, world.
        target: point that it looks at, world.
        fov_deg: horizontal angle of view, degrees.
    """

    name: str
    floor: Surface
    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov_deg: float

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """Floor first."""
        return (self.floor, *OBJECTS)

    def camera(self, size: int) -> Camera:
        """The view of ``size`` x ``size`` pixels."""
        return Camera.look_at(self.eye, self.target, fov_deg=self.fov_deg, width=size, height=size)


OUTSIDE = Place("", FLOOR, (4.2, -3.6, 3.0), (0.0, 0.0, 0.35), 27)
"""The usual view; a few pixels at the top miss the floor."""
ROOM = Place("room", Box((0.0, 0.0, 3.0), 3.0, inwards=True), (-2.6, -2.2, 1.5), (0.1, -0.1, 0.7), 60)
"""Within a cube on whose lower side they stand, at eye height near a corner."""
GROUND = Place("ground", Floor(10.0), (-2.6, -2.2, 1.5), (0.1, -0.1, 0.7), 60)
"""At eye height on a ground that goes on behind the camera; above the horizon there is nothing."""


def camera(size: int) -> Camera:
    """The usual view."""
    return OUTSIDE.camera(size)


def surfels(count: int, seed: int, recipe: Recipe = STUDY, place: Place = OUTSIDE) -> GaussianScene:
    """``count`` surfels over the surfaces of ``place``, in random order."""
    rng = seeds.generator(seed, "tracing", "surfels", *place.name.split(), count, recipe.degree)
    surfaces = place.surfaces
    areas = np.array([s.area for s in surfaces])
    shares = areas * np.where([s is place.floor for s in surfaces], FLOOR_SHARE, 1.0)
    ends = np.round(np.cumsum(shares) / shares.sum() * count).astype(int)
    numbers = np.diff(ends, prepend=0)
    points, normals = [], []
    for surface, number in zip(surfaces, numbers):
        u, v = r2_sequence(number, rng.random(2))
        p, n = surface.at(u, v)
        points.append(p)
        normals.append(n)
    means, outwards = np.concatenate(points), np.concatenate(normals)
    cell = np.repeat(areas / np.maximum(numbers, 1), numbers)
    if recipe.overlap > 0:
        sigma = np.sqrt(recipe.overlap * cell / np.pi) / 3
    else:
        sigma = 0.4 * np.minimum(neighbour_distances(means), 3 * np.sqrt(cell))
    tangent_frame = _frames(_tilted(outwards, recipe.tilt, rng), rng)
    scales = sigma[:, None] * np.exp(recipe.anisotropy * rng.normal(size=(count, 2)))
    opacities = np.full(count, recipe.opacity or 0.0)
    if recipe.opacity is None:
        opacities = np.clip(rng.beta(2.2, 0.6, count), 0.02, 0.989)
    colors = 0.5 + 0.5 * np.sin(2.3 * means + np.array([0.0, 1.0, 2.0]))
    order = rng.permutation(count)
    lifted = means + outwards * (recipe.lift * sigma * rng.normal(size=count))[:, None]
    return GaussianScene(
        means=lifted[order],
        quats=quats_from_matrices(tangent_frame)[order],
        log_scales=np.log(scales)[order],
        opacity_logits=logit(opacities)[order],
        sh=_harmonics(colors, recipe.sh_degree, rng)[order],
        base_color=colors[order],
        roughness=(0.5 + 0.4 * np.sin(3 * means[:, 0]))[order],
        metallic=(0.5 + 0.5 * np.sin(2 * means[:, 1]))[order],
        object_id=np.repeat(np.arange(len(surfaces)), numbers)[order],
        kernel_degree=recipe.degree,
        spacing=measure_spacing(lifted),
    ).validate()


def r2_sequence(count: int, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``count`` points of the R2 sequence, moved by ``shift`` (2,) on the torus: two (count,) arrays."""
    steps = np.arange(1, count + 1)[:, None] / _PLASTIC ** np.array([1, 2])
    points = (steps + shift) % 1.0
    return points[:, 0], points[:, 1]


def _tilted(normals: np.ndarray, deviation: float, rng: np.random.Generator) -> np.ndarray:
    tilted = normals + deviation * rng.normal(size=normals.shape)
    return tilted / np.linalg.norm(tilted, axis=1, keepdims=True)


def _frames(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(M, 3, 3) rotations whose third column is the normal, turned about it at random."""
    other = np.where(np.abs(normals[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    a = np.cross(other, normals)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(normals, a)
    angle = rng.uniform(0, 2 * np.pi, (len(normals), 1))
    u, v = a * np.cos(angle) + b * np.sin(angle), b * np.cos(angle) - a * np.sin(angle)
    return np.stack([u, v, normals], -1)


def _harmonics(colors: np.ndarray, degree: int, rng: np.random.Generator) -> np.ndarray:
    """(M, 16, 3) coefficients: the colour, and above it terms up to ``degree`` that fall with the order."""
    sh = np.zeros((len(colors), SH_COUNT, 3))
    sh[:, 0] = rgb_to_dc(colors)
    for order in range(1, degree + 1):
        band = slice(order**2, (order + 1) ** 2)
        sh[:, band] = 0.1 / order * rng.normal(size=(len(colors), 2 * order + 1, 3))
    return sh


def mitsuba_mesh() -> dict[str, Any]:
    """The same surfaces as white diffuse triangle meshes: shapes for ``mi.load_dict``.

    White, because then the radiance that leaves them is irradiance / pi, what TRON's pass computes.
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
