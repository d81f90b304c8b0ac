"""Random shapes of the zoo: triangles, a view, and the placement of surfels on them.

All fit the unit ball around the origin, z up. A kind has several individuals, which differ in
proportions, rotation and view.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter
from scipy.special import logit

from eval.zoo.materials import STRATA, WIDE_STRATA, Material, draw_materials
from tron.cameras import Camera
from tron.gaussians.edit import subset
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.models.parts import Part
from tron.models.sides import two_sided
from tron.models.surfels import surfels_of_model
from tron.seeds import generator, integer

SIDE, AWAY, FILLED = 64, 5.0, 0.94
"""Pixels of a view, distance of its camera, and share of its side that the unit ball fills."""
SPACING = 0.034
"""Of surfels: a pixel of what faces the camera."""
_SCALE = np.tan(np.arcsin(1 / AWAY)) / FILLED
FOV_DEG = float(2 * np.degrees(np.arctan(_SCALE)))
LAYERS, DEEP, SUNK, WIDER, TILTED, OPACITY = 4, 0.8, 0.65, 1.6, 0.35, (0.3, 0.9)
"""A scan-like fog: splats a surfel, their deviation along the normal and how far their middle lies within, in
spacings, their size over a surfel's, the deviation of their normals in radians, and their opacities. Sunk so,
cameras see half of its depth on the shape, as training leaves it; not sunk it was a ball 2 % larger."""

INDIVIDUALS = 2
"""Of a kind but of balls, whose only proportion is one; they share the kind's materials."""
BALL, COLORS = "ball", 2
"""Materials of a ball of either metallic and each stratum."""


@dataclass(frozen=True, eq=False)
class Shape:
    """One individual.

    Attributes:
        kind: of :data:`KINDS`. number: number of the individual within its kind.
        parts: its surface, of any material.
        camera: its view.
        jitter: deviation of its surfels along their normals, in spacings.
        fog: whether its surfels are those of a scan.
        seed: root of its surfels' random numbers.
    """

    kind: str
    number: int
    parts: Sequence[Part]
    camera: Camera
    jitter: float
    fog: bool
    seed: int

    def of(self, material: Material) -> list[Part]:
        """Return the surface in a material; a texture is multiplied by the material's base color."""
        return [of_material(part, material) for part in self.parts]

    def surfels(self, material: Material) -> GaussianScene:
        """Return surfels on the shape; their geometry does not depend on the material."""
        parts = self.of(material)
        scene = surfels_of_model(two_sided(parts), SPACING, seed=self.seed)
        if self.fog:
            return _fog(scene, generator(self.seed, "fog"))
        off = generator(self.seed, "jitter").normal(0, self.jitter * SPACING, (len(scene), 1))
        return replace(scene, means=np.asarray(scene.means + off * scene.normals(), np.float32))


def individuals(kinds: Sequence[str], most: int | None, seed: int) -> Iterator[tuple[Shape, list[Material]]]:
    """Yield shapes with their materials, in the order of the wall.

    Args:
        kinds: kinds of shapes.
        most: maximum number of materials of an individual; None: all.
        seed: root of all random numbers.
    """
    for kind in kinds:
        rng = generator(seed, "zoo", "materials", kind)
        if kind == BALL:
            yield draw_shape(kind, 0, seed), _some(draw_materials(rng, STRATA, COLORS), most)
            continue
        materials = draw_materials(rng, WIDE_STRATA)
        for number in range(INDIVIDUALS):
            yield draw_shape(kind, number, seed), _some(materials[number::INDIVIDUALS], most)


def _some(materials: list[Material], most: int | None) -> list[Material]:
    """Return at most so many items, evenly spaced."""
    return materials if most is None else materials[:: -(-len(materials) // most)]


def draw_shape(kind: str, number: int, seed: int) -> Shape:
    """Draw an individual of a kind."""
    rng = generator(seed, "zoo", "shape", kind, number)
    drawn = KINDS[kind](rng, number)
    azimuth, elevation = np.radians([drawn.azimuth_deg, rng.uniform(*drawn.elevation_deg)])
    level = np.cos(elevation)
    eye = AWAY * np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    camera = Camera.look_at(eye, (0, 0, 0), fov_deg=FOV_DEG, width=SIDE, height=SIDE)
    root = integer(seed, "zoo", "surfels", kind, number)
    return Shape(kind, number, fitted(drawn.parts), camera, drawn.jitter, drawn.fog, root)


@dataclass(frozen=True)
class _Drawn:
    """Random draw of a kind; the base color of its parts multiplies the material's."""

    parts: list[Part]
    azimuth_deg: float
    elevation_deg: tuple[float, float]
    jitter: float = 0.0
    fog: bool = False


def of_material(part: Part, material: Material) -> Part:
    """Return the part in a material."""
    color = (part.base_color * np.array(material.base_color)).astype(np.float32)
    return replace(part, base_color=color, roughness=material.roughness, metallic=material.metallic)


def fitted(parts: Sequence[Part]) -> list[Part]:
    """Scale parts into the unit ball."""
    corners = np.concatenate([part.vertices for part in parts])
    middle = (corners.min(0) + corners.max(0)) / 2
    radius = np.linalg.norm(corners - middle, axis=1).max()
    return [replace(part, vertices=(part.vertices - middle) / radius) for part in parts]


def _ball(rng: np.random.Generator, _: int) -> _Drawn:
    sphere = trimesh.creation.icosphere(subdivisions=5)
    part = _part(np.array(sphere.vertices), np.array(sphere.vertices), np.array(sphere.faces))
    return _Drawn([part], rng.uniform(0, 360), (-20, 60))


def _thick(rng: np.random.Generator, number: int) -> _Drawn:
    return replace(_ball(rng, number), fog=True)


def _bowl(rng: np.random.Generator, _: int) -> _Drawn:
    """A part of a sphere with a wall, from a dish to more than half."""
    end, wall = np.pi - rng.uniform(1.0, 1.7), rng.uniform(0.12, 0.25)
    polar, around = np.linspace(np.pi, end, 49), np.linspace(0, 2 * np.pi, 97)
    outer, inner = (_revolved(r * np.sin(polar), r * np.cos(polar), around) for r in (1.0, 1 - wall))
    r = np.linspace(1 - wall, 1, 5)
    rim = _revolved(r * np.sin(end), r * np.cos(end), around)
    return _Drawn([_sheet_of(outer[::-1]), _sheet_of(inner), _sheet_of(rim)], 0.0, (35, 65))


def _box(rng: np.random.Generator, _: int) -> _Drawn:
    return _Drawn(_cuboid(np.zeros(3), rng.uniform(0.5, 1, 3)), rng.uniform(0, 360), (10, 50))


def _steps(rng: np.random.Generator, _: int) -> _Drawn:
    """Three or four steps; corners between them see each other."""
    count, width = int(rng.integers(3, 5)), rng.uniform(0.7, 1.2)
    rise, tread = rng.uniform(0.25, 0.4, 2)
    parts = []
    for n in range(count):
        near, far, low, top = n * tread, (n + 1) * tread, n * rise, (n + 1) * rise
        parts += [
            polygon([(0, near, low), (width, near, low), (width, near, top), (0, near, top)]),
            polygon([(0, near, top), (width, near, top), (width, far, top), (0, far, top)]),
            polygon([(0, near, 0), (0, near, top), (0, far, top), (0, far, 0)]),
            polygon([(width, near, 0), (width, far, 0), (width, far, top), (width, near, top)]),
        ]
    back, height = count * tread, count * rise
    parts.append(polygon([(0, back, 0), (0, back, height), (width, back, height), (width, back, 0)]))
    parts.append(polygon([(0, 0, 0), (0, back, 0), (width, back, 0), (width, 0, 0)]))
    return _Drawn(parts, -90 + rng.uniform(-50, 50), (15, 45))


def _sheet(rng: np.random.Generator, _: int) -> _Drawn:
    """Two layers back to back, flat or rolled, nothing or a spacing between them."""
    bend, gap = rng.uniform(0, 2), rng.uniform(0, 1) * SPACING
    u, v = np.meshgrid(np.linspace(-1, 1, 65), np.linspace(-0.7, 0.7, 49), indexing="ij")

    def layer(lift: float) -> np.ndarray:
        if bend < 0.3:
            return np.stack([u, v, np.full_like(u, lift)], -1)
        r = 1 / bend + lift
        return np.stack([r * np.sin(u * bend), v, r * np.cos(u * bend)], -1)

    parts = [_sheet_of(layer(0.0)), _sheet_of(layer(-gap)[::-1])]
    turn = trimesh.transformations.euler_matrix(rng.uniform(-0.6, 0.6), 0, rng.uniform(0, 2 * np.pi))
    return _Drawn([part.moved(turn) for part in parts], 0.0, (20, 60), rng.uniform(0, 0.25))


def _leaf(rng: np.random.Generator, number: int) -> _Drawn:
    """A bent leaf of one layer, seen from its front or, each other one, from its back."""
    bend, fold, width = rng.uniform(0.4, 1.4), rng.uniform(-0.5, 0.5), rng.uniform(0.3, 0.6)
    u, v = np.meshgrid(np.linspace(0.01, 0.99, 65), np.linspace(-1, 1, 41), indexing="ij")
    across = v * width * np.sin(np.pi * u) ** 0.8
    angle = bend * (u - 0.5)
    points = np.stack([np.sin(angle) / bend, across, np.cos(angle) / bend + fold * across**2], -1)
    part = _sheet_of(points if number % 2 == 0 else points[::-1])
    turn = trimesh.transformations.euler_matrix(rng.uniform(-0.5, 0.5), 0, rng.uniform(0, 2 * np.pi))
    return _Drawn([part.moved(turn)], 0.0, (30, 70), rng.uniform(0, 0.25))


def _wire(rng: np.random.Generator, _: int) -> _Drawn:
    """A coil whose wire is four pixels thick."""
    turns, height, thick = rng.uniform(1.5, 2.5), rng.uniform(0.4, 0.9), 0.075
    t, around = np.meshgrid(np.linspace(0, 1, 241), np.linspace(0, 2 * np.pi, 25), indexing="ij")
    angle = 2 * np.pi * turns * t
    core = np.stack([np.cos(angle), np.sin(angle), height * (2 * t - 1)], -1)
    along = np.stack([-np.sin(angle), np.cos(angle), np.full_like(t, height / (np.pi * turns))], -1)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(t)], -1)
    other = np.cross(along / np.linalg.norm(along, axis=-1, keepdims=True), out)
    tube = core + thick * (out * np.cos(around)[..., None] + other * np.sin(around)[..., None])
    return _Drawn([_sheet_of(tube[:, ::-1])], rng.uniform(0, 360), (5, 50))


def _room(rng: np.random.Generator, number: int) -> _Drawn:
    """Five single polygons, seen from within; each other one has its normals outward."""
    walls = _cuboid(np.zeros(3), rng.uniform(0.6, 1, 3))[1:]
    walls = [_flipped(wall) for wall in walls] if number % 2 else walls
    return _Drawn(walls, rng.uniform(-25, 25), (-5, 30))


def _crate(rng: np.random.Generator, number: int) -> _Drawn:
    """The same from without."""
    return replace(_room(rng, number), azimuth_deg=180 + rng.uniform(-60, 60), elevation_deg=(5, 40))


def _relief(rng: np.random.Generator, _: int) -> _Drawn:
    """Stones and grain down to a spacing, with a texture as fine."""
    texels = 256
    fields = [gaussian_filter(rng.normal(size=(texels, texels)), sigma) for sigma in (16, 6, 1.5)]
    coarse, middle, grain = (each / each.std() for each in fields)
    height = 0.03 * np.maximum(coarse, -0.3) + 0.01 * np.maximum(middle, 0) + 0.0015 * grain
    side = (np.arange(texels) + 0.5) / texels
    u, v = np.meshgrid(side, side, indexing="ij")
    part = _sheet_of(np.stack([2 * u - 1, 2 * v - 1, height], -1))
    shade = np.clip(0.65 + 0.2 * middle + 0.15 * grain, 0.1, 1)
    texture = np.repeat(shade.T[..., None], 3, axis=-1).astype(np.float32)
    uv = np.stack([u, v], -1).reshape(-1, 2).astype(np.float32)
    return _Drawn([replace(part, uv=uv, base_color=texture)], rng.uniform(0, 360), (30, 60))


KINDS: dict[str, Callable[[np.random.Generator, int], _Drawn]] = {
    "ball": _ball,
    "bowl": _bowl,
    "box": _box,
    "steps": _steps,
    "sheet": _sheet,
    "leaf": _leaf,
    "wire": _wire,
    "crate": _crate,
    "room": _room,
    "relief": _relief,
    "thick": _thick,
}


def _part(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> Part:
    return Part(vertices, normals, faces, None, np.ones(3, np.float32), 1.0, 0.0, None)


def polygon(corners: ArrayLike) -> Part:
    """Four corners, counter-clockwise seen from the front."""
    points = np.asarray(corners, np.float64)
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    return _part(points, np.tile(normal / np.linalg.norm(normal), (4, 1)), np.array([[0, 1, 2], [0, 2, 3]]))


def _flipped(part: Part) -> Part:
    return replace(part, normals=-part.normals, faces=part.faces[:, ::-1])


def _cuboid(middle: np.ndarray, half: np.ndarray) -> list[Part]:
    """Its faces, the one towards +x first."""
    found = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            n, a, b = sign * np.eye(3)[axis], np.eye(3)[(axis + 1) % 3], sign * np.eye(3)[(axis + 2) % 3]
            found.append(
                polygon(
                    [middle + half * (n + i * a + j * b) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
                )
            )
    return found


def _revolved(radius: np.ndarray, height: np.ndarray, around: np.ndarray) -> np.ndarray:
    """(N, M, 3) of a profile turned about z."""
    c, s = np.cos(around), np.sin(around)
    return np.stack([radius[:, None] * c, radius[:, None] * s, np.repeat(height[:, None], len(c), 1)], -1)


def _sheet_of(points: np.ndarray) -> Part:
    """A lattice (N, M, 3) as smooth triangles; its front is where the second axis turns left of the first."""
    rows, columns = points.shape[:2]
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (q.ravel() for q in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = points.reshape(-1, 3)
    x, y, z = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(y - x, z - x)
    # Seams are two rows of vertices in one place, which share their normals.
    _, same = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    same = same.ravel()
    sums = np.zeros((same.max() + 1, 3))
    for k in range(3):
        np.add.at(sums, same[faces[:, k]], cross)
    normals = sums[same]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    whole = np.linalg.norm(cross, axis=1) > 1e-12
    return _part(vertices, normals, faces[whole])


def _fog(scene: GaussianScene, rng: np.random.Generator) -> GaussianScene:
    """Splats around surfels, as training leaves them: thick, half transparent, of no sign."""
    many = subset(scene, np.tile(np.arange(len(scene)), LAYERS))
    normals = many.normals()
    means = many.means + normals * rng.normal(-SUNK * SPACING, DEEP * SPACING, (len(many), 1))
    tilted = normals + rng.normal(0, TILTED, normals.shape)
    tilted *= np.where(rng.random((len(many), 1)) < 0.5, -1, 1) / np.linalg.norm(
        tilted, axis=1, keepdims=True
    )
    return replace(
        many,
        means=means.astype(np.float32),
        quats=quats_from_normals(tilted.astype(np.float32)),
        log_scales=many.log_scales + np.float32(np.log(WIDER)),
        opacity_logits=logit(rng.uniform(*OPACITY, len(many))).astype(np.float32),
        oriented=False,
    ).validate()
