"""Small random worlds, as meshes for Mitsuba and as surfels of the same meshes, with their truth.

Things of plain shapes stand on a patterned ground under an open sky. Surfels are made as in ``tron-edit``
(:func:`tron.models.surfels.surfels_of_model`): their positions and materials are exact, so only the light is
judged. Mitsuba's path tracer, which shares no code with TRON's, sees the meshes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from eval.tracing.scene import LIGHTS, Box, Sphere, Surface, Torus
from tron.brdf.bsdf import metallic_roughness
from tron.cameras import Camera, mitsuba_sensor
from tron.gaussians.edit import joined
from tron.gaussians.scene import GaussianScene
from tron.models.parts import Part
from tron.models.surfels import surfels_of_model
from tron.seeds import generator, integer
from tron.shading.environments.environment import EnvironmentMap

GROUND = 1
"""Object id of the ground; things follow."""
HALF = 2.0
"""Half the side of the ground, world units."""
CELLS = 160
"""Of the ground's mesh along a side: its pattern is in the colours of the corners."""
BOUNCES = 4
"""Times that light bounces between surfaces, in the truth as in :class:`tron.estimation.Estimation`."""
PLACES = ((-0.95, 0.75), (0.95, 0.8), (0.0, 1.2), (-1.25, -0.15), (1.25, -0.1))
"""Where things may stand, so that the middle is free."""


@dataclass(frozen=True)
class World:
    """Meshes under a light.

    Attributes:
        parts: the ground, then the things, numbered in this order from :data:`GROUND` on.
        light: environment of the meshes.
        seed: root of their random numbers.
    """

    parts: tuple[Part, ...]
    light: EnvironmentMap
    seed: int

    def surfels(self, count: int) -> GaussianScene:
        """Return about ``count`` surfels, evenly by area, with the parts' numbers as object ids."""
        return surfels_of(self.parts, np.sqrt(self.area / count), self.seed)

    @property
    def area(self) -> float:
        """Area of all surfaces, world units squared."""
        corners = [part.vertices[part.faces] for part in self.parts]
        crosses = [np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in corners]
        return float(sum(0.5 * np.linalg.norm(each, axis=1).sum() for each in crosses))

    def traced(self, camera: Camera, spp: int, seed: int) -> np.ndarray:
        """Render linear radiance (H, W, 3) by Mitsuba's path tracer."""
        scene = _mitsuba(self.parts, self.light)
        sensor = mitsuba_sensor(camera, spp)
        sensor["sampler"]["type"] = "multijitter"
        integrator = mi.load_dict({"type": "path", "max_depth": BOUNCES + 2, "rr_depth": BOUNCES + 2})
        image = mi.render(
            scene, sensor=mi.load_dict(sensor), integrator=integrator, spp=spp, seed=mi.UInt32(seed)
        )
        return np.array(image)[..., :3]

    def surface(self, camera: Camera) -> TrueSurface:
        """Return the surface hit by Mitsuba's rays through the pixel centres."""
        scene = _mitsuba(self.parts, None)
        along = camera.rays().reshape(-1, 3)
        origin, direction = (mi.Point3f(*camera.position.tolist()), mi.Vector3f(*along.T.astype(np.float32)))
        hit = scene.ray_intersect(mi.Ray3f(origin, direction))
        there = np.array(hit.is_valid())
        normal, color = np.array(hit.sh_frame.n).T, np.zeros((len(along), 3))
        number = np.zeros(len(along), np.int32)
        shapes = {shape.id(): shape for shape in scene.shapes()}
        for n in range(len(self.parts)):
            shape = shapes[f"part{n}"]
            mine = hit.is_valid() & (hit.shape == mi.ShapePtr(shape))
            which = np.array(mine)
            number[which] = GROUND + n
            color[which] = np.array(shape.eval_attribute_3("vertex_color", hit, mine)).T[which]
        size = camera.height, camera.width
        distance = np.where(there, np.array(hit.t), 0.0)
        return TrueSurface(
            distance.reshape(*size, 1),
            np.where(there[:, None], normal, 0).reshape(*size, 3),
            color.reshape(*size, 3),
            number.reshape(size),
        )


class TrueSurface(NamedTuple):
    """Buffers of a frame: distance (H, W, 1), normal, base color (H, W, 3), number of the part (H, W)."""

    depth: np.ndarray
    normal: np.ndarray
    base_color: np.ndarray
    number: np.ndarray


def draw_world(seed: int, name: str, number: int, light: str, things: int = 3) -> World:
    """Draw a world for a part of a benchmark.

    Args:
        seed: root of all random numbers.
        name: of the part.
        number: of the world, which names its random streams.
        light: kind, of :data:`eval.tracing.scene.LIGHTS`; its turn about up is drawn.
        things: that stand on the ground, none in its middle.
    """
    rng = generator(seed, "applications", name, number)
    places = rng.permutation(len(PLACES))[:things]
    parts = [draw_ground(rng), *(moved(draw_thing(rng), (*PLACES[place], 0.0)) for place in places)]
    turned = LIGHTS[light]().rotated(float(rng.uniform(0, 360)))
    return World(tuple(parts), turned, integer(seed, "applications", name, number, "surfels"))


def draw_ground(rng: np.random.Generator) -> Part:
    """Draw a matt ground with checks, stripes or blotches of two colours."""
    side = np.linspace(-HALF, HALF, CELLS + 1)
    x, y = (each.ravel() for each in np.meshgrid(side, side))
    angle, period = rng.uniform(0, np.pi), rng.uniform(0.4, 0.9)
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    kind = rng.integers(3)
    if kind == 0:
        share = (np.floor(along / period) + np.floor(across / period)) % 2
    elif kind == 1:
        share = np.floor(along / period * 2) % 2
    else:
        waves = rng.uniform(2, 6, (5, 2))
        share = 0.5 + 0.5 * np.mean(np.sin(x[:, None] * waves[:, 0] + y[:, None] * waves[:, 1]), axis=1)
    colors = rng.uniform(0.08, 0.7, (2, 1)) * (0.6 + 0.4 * rng.random((2, 3)))
    corner = np.arange((CELLS + 1) ** 2).reshape(CELLS + 1, CELLS + 1)
    a, b, c, d = (q.ravel() for q in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    points = np.stack([x, y, np.zeros_like(x)], axis=1)
    color = colors[0] + share[:, None] * (colors[1] - colors[0])
    roughness = float(rng.uniform(0.5, 0.95))
    return Part(points, np.tile([0.0, 0.0, 1.0], (len(x), 1)), faces, None, color, roughness, 0.0, None)


def draw_thing(rng: np.random.Generator) -> Part:
    """Draw a ball, box, lying ring, vase, or ball on a box, of one material, standing on the origin."""
    size = float(rng.uniform(0.32, 0.5))
    kind = rng.integers(5)
    shapes: list[Surface]
    if kind == 0:
        shapes = [Sphere((0, 0, size), size)]
    elif kind == 1:
        shapes = [Box((0, 0, size), size)]
    elif kind == 2:
        tube = 0.45 * size
        shapes = [Torus((0, 0, tube), 1.1 * size, tube)]
    elif kind == 3:
        shapes = [Vase(size, rng.uniform(0.35, 0.9), rng.uniform(0, 2 * np.pi))]
    else:
        foot = 0.7 * size
        shapes = [Box((0, 0, foot), foot), Sphere((0, 0, 2 * foot + 0.75 * size), 0.75 * size)]
    meshes = [shape.mesh(64) for shape in shapes]
    offsets = np.cumsum([0, *(len(points) for points, _, _ in meshes)])
    points, normals = (np.concatenate([mesh[k] for mesh in meshes]) for k in (0, 1))
    faces = np.concatenate([mesh[2] + offset for mesh, offset in zip(meshes, offsets)])
    metal = rng.random() < 0.25
    color = rng.uniform(0.15, 0.8) * (0.35 + 0.65 * rng.random(3))
    color = 0.5 + 0.5 * color if metal else color
    turn = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    roughness = float(rng.uniform(0.3, 0.9))
    return Part(
        points @ rotation.T, normals @ rotation.T, faces, None, np.tile(color, (len(points), 1)),
        roughness, float(metal), None,
    )  # fmt: skip


@dataclass(frozen=True)
class Vase(Surface):
    """A body of revolution about z with a waist, closed above and below; it stands on the origin.

    Attributes:
        size: half its height.
        depth: of its waist, of the radius.
        phase: where the waist is, radians.
    """

    size: float
    depth: float
    phase: float

    @property
    def area(self) -> float:
        """Area in world units squared, by Guldin's rule on its polygon of 1,000 corners."""
        radius, height = self._profile(np.linspace(0, 1, 1001))
        return float(np.pi * ((radius[1:] + radius[:-1]) * np.hypot(np.diff(radius), np.diff(height))).sum())

    def at(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points and normals; v runs from the centre of the foot to the centre of the top."""
        radius, height = self._profile(v)
        step = 1e-5
        (r0, z0), (r1, z1) = (self._profile(np.clip(v + d, 0, 1)) for d in (-step, step))
        dr, dz = r1 - r0, z1 - z0
        length = np.maximum(np.hypot(dr, dz), 1e-12)
        c, s = np.cos(2 * np.pi * u), np.sin(2 * np.pi * u)
        normals = np.stack([c * dz / length, s * dz / length, -dr / length], axis=1)
        return np.stack([radius * c, radius * s, height], axis=1), normals

    def patches(self, fineness: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return lattices of foot, side and top; separate lattices keep the edges sharp."""
        around = np.linspace(0, 1, fineness + 1)
        ends = ((1e-4, 0.1 - 1e-4), (0.1 + 1e-4, 0.9 - 1e-4), (0.9 + 1e-4, 1 - 1e-4))
        return [(around, np.linspace(*end, fineness // 2 + 1)) for end in ends]

    def _profile(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        side = np.clip((v - 0.1) / 0.8, 0, 1)
        wave = 1 - self.depth * 0.5 * (1 + np.sin(2 * np.pi * side + self.phase))
        radius = 0.7 * self.size * wave
        radius = radius * np.where(v < 0.1, v / 0.1, np.where(v > 0.9, (1 - v) / 0.1, 1.0))
        return radius, 2 * self.size * side


def moved(
    part: Part,
    shift: Sequence[float] | np.ndarray,
    turn_deg: float = 0.0,
    about: Sequence[float] | np.ndarray = (0, 0, 0),
) -> Part:
    """Turn a part counter-clockwise about a vertical axis through a point, then shift it."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    vertices = (part.vertices - about) @ rotation.T + about + np.asarray(shift)
    return replace(part, vertices=vertices, normals=part.normals @ rotation.T)


def surfels_of(parts: Sequence[Part], spacing: float, seed: int, first: int = GROUND) -> GaussianScene:
    """Return surfels of parts at one spacing; parts are numbered from ``first`` on."""
    scenes = [
        surfels_of_model([part], spacing, object_id=first + n, seed=integer(seed, n))
        for n, part in enumerate(parts)
    ]
    both = scenes[0]
    for other in scenes[1:]:
        both = joined(both, other)
    return both.validate()


def view_of(
    rng: np.random.Generator, width: int, height: int, target: Sequence[float] = (0, 0.1, 0.3)
) -> Camera:
    """Draw a camera that faces the things, 3.6 units from the middle, 22 to 40 degrees high."""
    azimuth, elevation = np.radians(rng.uniform(-125, -55)), np.radians(rng.uniform(22, 40))
    level = np.cos(elevation)
    toward = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    eye = np.asarray(target) + 3.6 * toward
    return Camera.look_at(eye, target, fov_deg=44, width=width, height=height)


def _mitsuba(parts: Sequence[Part], light: EnvironmentMap | None) -> mi.Scene:
    meshes = {f"part{n}": _mesh(f"part{n}", part) for n, part in enumerate(parts)}
    lights = {} if light is None else {"light": light.to_mitsuba()}
    return mi.load_dict({"type": "scene", **meshes, **lights})


def _mesh(name: str, part: Part) -> mi.Mesh:
    """Return a two-sided Mitsuba mesh with vertex colours and the material of :mod:`tron.brdf`."""
    colors = {"type": "mesh_attribute", "name": "vertex_color"}
    material = metallic_roughness(colors, part.roughness, part.metallic)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": material})
    mesh = mi.Mesh(name, len(part.vertices), len(part.faces), properties, has_vertex_normals=True)
    mesh.add_attribute("vertex_color", 3, part.base_color.astype(np.float32).ravel())  # pyright: ignore
    values = mi.traverse(mesh)
    values["vertex_positions"] = part.vertices.astype(np.float32).ravel()
    values["vertex_normals"] = part.normals.astype(np.float32).ravel()
    values["faces"] = part.faces.astype(np.uint32).ravel()
    values.update()
    return mesh
