"""Solids that kinds are put together from, as manifolds: closed and outward-facing by construction.

manifold3d guarantees that booleans, hulls, extrusions and revolutions of manifolds are manifolds; what is
made from arrays of our own goes through :func:`closed`, which refuses anything else.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product

import numpy as np
from manifold3d import CrossSection, Error, Manifold, Mesh64, OpType
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import map_coordinates, spline_filter
from trimesh import Trimesh

from tron.errors import TronError

Solid = Manifold | Trimesh
Parts = list[tuple[Solid, int]]
"""What a kind builds: solids in any unit, z up, each with the number of its material slot."""

Vector = Sequence[float] | np.ndarray


def between(fraction: float, low: float, high: float) -> float:
    """``low`` at 0, ``high`` at 1."""
    return float(low + fraction * (high - low))


def count(fraction: float, low: int, high: int) -> int:
    """One of the integers ``low`` to ``high``, both included, by a fraction in [0, 1]."""
    return low + min(int(fraction * (high - low + 1)), high - low)


def closed(vertices: np.ndarray, faces: np.ndarray) -> Manifold:
    """Solid of a triangle mesh (V, 3), (F, 3) that is closed and faces outwards already.

    Raises:
        TronError: it is not, or it encloses nothing.
    """
    mesh = Mesh64(
        vert_properties=np.array(vertices, np.float64, order="C"),
        tri_verts=np.array(faces, np.uint64, order="C"),
    )
    solid = Manifold(mesh)
    if solid.status() != Error.NoError or not solid.volume() > 0.0:
        raise TronError(f"a mesh of {len(faces)} triangles is not a closed solid")
    return solid


def union(solids: Iterable[Manifold]) -> Manifold:
    """Union of solids, which may overlap."""
    return Manifold.batch_boolean(list(solids), OpType.Add)


def largest(solid: Manifold) -> Manifold:
    """The connected component of the greatest volume."""
    return max(solid.decompose(), key=lambda part: part.volume())


def rounded_box(sides: Vector, radius: float, centre: Vector = (0.0, 0.0, 0.0)) -> Manifold:
    """Box of three side lengths whose edges are rounded with ``radius``."""
    sides = np.asarray(sides, dtype=np.float64)
    radius = min(radius, 0.45 * float(sides.min()))
    ball = Manifold.sphere(radius, 12)
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * (sides - 2.0 * radius) + centre
    return Manifold.batch_hull([ball.translate(_triple(corner)) for corner in corners])


def post(a: Vector, b: Vector, sides_a: Vector, sides_b: Vector | None = None) -> Manifold:
    """Straight member between two points, its ends rectangles (x side, y side) parallel to the floor."""
    ends = []
    for end, sides in ((a, sides_a), (b, sides_a if sides_b is None else sides_b)):
        x, y = 0.5 * np.asarray(sides, dtype=np.float64)
        ends += [(end[0] + i * x, end[1] + j * y, end[2]) for i, j in product((-1, 1), repeat=2)]
    return Manifold.hull_points(np.array(ends))


def rod(a: Vector, b: Vector, radius: float, radius_b: float | None = None, sections: int = 12) -> Manifold:
    """Round bar between two points, tapering from ``radius`` to ``radius_b``."""
    radii = np.array([radius, radius if radius_b is None else radius_b])
    return tube(np.array([a, b], dtype=np.float64), radii, sections=sections)


def tube(
    path: np.ndarray,
    radius: float | np.ndarray,
    *,
    sections: int = 12,
    loop: bool = False,
) -> Manifold:
    """Round tube of a radius, or one a point (N,), along a path (N, 3); flat ends, or closed to a loop.

    The frame of the rings is transported with the least rotation (double reflection, Wang et al. 2008); on a
    loop what is left over after one turn is spread over the path. Curves tighter than the radius overlap.
    """
    path = np.asarray(path, dtype=np.float64)
    n = len(path)
    tangents = np.roll(path, -1, 0) - np.roll(path, 1, 0) if loop else np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    firsts = _frames(path, tangents)
    twist = np.zeros(n)
    if loop:
        back = _transport(firsts[-1], path[-1], path[0], tangents[-1], tangents[0])
        second = np.cross(tangents[0], firsts[0])
        twist = -np.arange(n) / n * np.arctan2(back @ second, back @ firsts[0])
    seconds = np.cross(tangents, firsts)
    angle = np.arange(sections) * 2 * np.pi / sections + twist[:, None]
    radii = np.broadcast_to(radius, n)[:, None, None]
    rings = path[:, None] + radii * (
        np.cos(angle)[..., None] * firsts[:, None] + np.sin(angle)[..., None] * seconds[:, None]
    )
    spans = n if loop else n - 1
    i, j = (a.ravel() for a in np.meshgrid(np.arange(spans), np.arange(sections), indexing="ij"))
    k, m = (i + 1) % n * sections, (j + 1) % sections
    a, b, c, d = i * sections + j, i * sections + m, k + m, k + j
    faces = [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    vertices = rings.reshape(-1, 3)
    if not loop:
        around, onward = np.arange(sections), (np.arange(sections) + 1) % sections
        low, top = np.full(sections, n * sections), np.full(sections, n * sections + 1)
        offset = (n - 1) * sections
        faces += [
            np.column_stack([onward, around, low]),
            np.column_stack([around + offset, onward + offset, top]),
        ]
        vertices = np.concatenate([vertices, path[[0, -1]]])
    return closed(vertices, np.concatenate(faces))


def _frames(path: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """(N, 3) unit vectors across the tangents that turn as little as they can."""
    axis = np.eye(3)[int(np.abs(tangents[0]).argmin())]
    first = np.cross(tangents[0], axis)
    firsts = [first / np.linalg.norm(first)]
    for i in range(len(path) - 1):
        firsts.append(_transport(firsts[i], path[i], path[i + 1], tangents[i], tangents[i + 1]))
    return np.array(firsts)


def _transport(first: np.ndarray, a: np.ndarray, b: np.ndarray, at_a: np.ndarray, at_b: np.ndarray):
    step = b - a
    scale = 2.0 / (step @ step)
    first = first - scale * (step @ first) * step
    reflected = at_a - scale * (step @ at_a) * step
    turn = at_b - reflected
    size = turn @ turn
    first = first - 2.0 / size * (turn @ first) * turn if size > 1e-18 else first
    first = first - (first @ at_b) * at_b
    return first / np.linalg.norm(first)


def smooth_profile(heights: Vector, radii: Vector, n: int = 48) -> np.ndarray:
    """(n, 2) points (radius, height) of a monotone cubic through the given ones: it never overshoots."""
    z = np.linspace(heights[0], heights[-1], n)
    return np.column_stack([PchipInterpolator(heights, radii)(z), z])


def turned(profile: np.ndarray, sections: int = 64) -> Manifold:
    """Solid of revolution under a profile (N, 2) of (radius, height), heights rising."""
    low, high = (0.0, profile[0, 1]), (0.0, profile[-1, 1])
    return CrossSection([np.array([low, *profile, high])]).revolve(sections)


def vessel(profile: np.ndarray, wall: float, sections: int = 64) -> Manifold:
    """Solid of revolution under a profile, hollowed to a wall thickness and open at the top."""
    mirrored = profile[::-1] * (-1.0, 1.0)
    outside = CrossSection([np.concatenate([profile, mirrored])])
    top = float(profile[-1, 1])
    raised = np.concatenate([profile, [[profile[-1, 0], top + 4.0 * wall]]])
    shell = CrossSection([np.concatenate([raised, raised[::-1] * (-1.0, 1.0)])]).offset(-wall)
    rest = outside - shell
    lowest, reach = float(profile[0, 1]), float(profile[:, 0].max()) + 1.0
    half = CrossSection.square((reach, top - lowest + 2.0)).translate((0.0, lowest - 1.0))
    return largest((rest ^ half).revolve(sections))


def sheet(points: np.ndarray, thickness: float) -> Manifold:
    """Sheet of a thickness around a grid of points (n, m, 3), closed along its rim."""
    along, across = np.gradient(points, axis=0), np.gradient(points, axis=1)
    normal = np.cross(along, across)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    return slab(points + 0.5 * thickness * normal, points - 0.5 * thickness * normal)


def slab(top: np.ndarray, bottom: np.ndarray) -> Manifold:
    """Solid between two grids of points (n, m, 3), the upper and the lower side of a slab."""
    n, m = top.shape[:2]
    index = np.arange(n * m).reshape(n, m)
    a, b = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
    c, d = index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    rim = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    ahead = np.roll(rim, -1)
    under = n * m
    sides = [
        np.column_stack([rim, rim + under, ahead + under]),
        np.column_stack([rim, ahead + under, ahead]),
    ]
    vertices = np.concatenate([top.reshape(-1, 3), bottom.reshape(-1, 3)])
    return closed(vertices, np.concatenate([faces, faces[:, ::-1] + under, *sides]))


def layers(grids: Iterable[np.ndarray]) -> Trimesh:
    """Sheets without a thickness through grids of points (n, m, 3), none sharing a vertex with another."""
    vertices, faces, first = [], [], 0
    for points in grids:
        n, m = points.shape[:2]
        index = first + np.arange(n * m).reshape(n, m)
        a, b, c, d = (
            part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
        )
        faces += [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
        vertices.append(points.reshape(-1, 3))
        first += n * m
    return Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = vector
    return float(x), float(y), float(z)


LATTICE = 16
"""Points a side of the periodic lattice."""


class Noise:
    """Fractal noise of zero mean and unit variance over its lattice.

    Octave k has ``2^k`` times the frequency and ``gain^k`` times the amplitude of octave 0 (Perlin 1985, with
    spline-interpolated values in place of gradients).

    Args:
        rng: source of the lattice and of each octave's offset.
        octaves: how many.
        gain: amplitude of an octave over that of the one below it; 0.5 is rock, 0.3 is smooth.
    """

    def __init__(self, rng: np.random.Generator, octaves: int = 4, gain: float = 0.5):
        lattice = spline_filter(rng.standard_normal((LATTICE,) * 3), order=3, mode="grid-wrap")
        line = np.stack(np.meshgrid(*[np.arange(0, LATTICE, 0.5)] * 3, indexing="ij")).reshape(3, -1)
        values = map_coordinates(lattice, line, order=3, mode="grid-wrap", prefilter=False)
        self._lattice = (lattice - values.mean()) / values.std()
        self._offsets = rng.uniform(0.0, LATTICE, (octaves, 3))
        self._amplitudes = gain ** np.arange(octaves)
        self._amplitudes /= np.linalg.norm(self._amplitudes)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """(N,) values at ``points`` (N, 3); one unit of length is one cell of octave 0."""
        points = np.asarray(points, dtype=np.float64)
        total = np.zeros(len(points))
        for k, (offset, amplitude) in enumerate(zip(self._offsets, self._amplitudes)):
            at = (points * 2.0**k + offset).T
            total += amplitude * map_coordinates(
                self._lattice, at, order=3, mode="grid-wrap", prefilter=False
            )
        return total
