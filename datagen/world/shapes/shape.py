"""A shape as data, and the interface of kinds of shapes.

A kind, a size, four proportions and a seed become triangle meshes, a piece for each material.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import trimesh
from manifold3d import Error
from trimesh import Trimesh

from datagen.world.shapes.solids import Parts, Solid
from datagen.world.spec import Number, Spec
from tron.errors import TronError

MOST_TRIANGLES = 60_000
"""Of one piece. A large one gets longer edges instead: its detail lies in textures, not in its mesh."""

CREASE_DEG = 35.0

Role = Literal[
    "any",
    "wood",
    "stone",
    "brick",
    "tiles",
    "fabric",
    "metal",
    "ceramic",
    "plastic",
    "leaf",
    "bark",
    "paper",
    "plaster",
    "ground",
    "leather",
]
"""What a part of a shape is made of."""


class ShapeSpec(Spec):
    """A procedural shape.

    Attributes:
        kind: a name in SHAPES.
        size: radius in world units of the ball around the origin that the shape just fits.
        parameters: proportions in (0, 1), whose meaning is the kind's own.
        seed: of the shape's own detail, such as the relief of a rock.
    """

    kind: str
    size: Number
    parameters: tuple[Number, Number, Number, Number]
    seed: int = 0


class Piece(NamedTuple):
    """The triangles of one material slot, in the object's frame: z up, world units."""

    mesh: Trimesh
    slot: int


@dataclass(frozen=True)
class Kind:
    """A kind of shape.

    Attributes:
        build: from parameters (4,) and a random stream to solids of any size, anywhere, z up.
        upright: it stands as built and only turns about z; otherwise it comes to rest on any side.
        roles: for each slot what it is made of.
        seeded: it has detail that its parameters do not say.
    """

    build: Callable[[np.ndarray, np.random.Generator], Parts]
    upright: bool = False
    roles: tuple[Role, ...] = ("any",)
    seeded: bool = True


def fit(parts: Parts, size: float, edge: float) -> list[Piece]:
    """Pieces centred at the origin and scaled to a ball of radius ``size``, edges at most ``edge`` long.

    The edges of a manifold that would have more than MOST_TRIANGLES are longer.

    Raises:
        TronError: a part is empty, or has more triangles than that as it was built.
    """
    centre, scale = frame(parts, size)
    return [Piece(_refined(solid, centre, scale, edge), slot) for solid, slot in parts]


def frame(parts: Parts, size: float) -> tuple[np.ndarray, float]:
    """Return centre (3,) and scale of :func:`fit`: x -> (x - centre) * scale."""
    vertices = np.concatenate([_vertices(solid) for solid, _ in parts])
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    return centre, float(size / np.linalg.norm(vertices - centre, axis=1).max())


def _vertices(solid: Solid) -> np.ndarray:
    if isinstance(solid, Trimesh):
        return np.asarray(solid.vertices, np.float64)
    if solid.status() != Error.NoError or solid.is_empty():
        raise TronError("a part of a shape is empty")
    return np.asarray(solid.to_mesh64().vert_properties)[:, :3]


def _refined(solid: Solid, centre: np.ndarray, scale: float, edge: float) -> Trimesh:
    if isinstance(solid, Trimesh):
        vertices = (np.asarray(solid.vertices) - centre) * scale
        fine = trimesh.remesh.subdivide_to_size(vertices, solid.faces, edge, max_iter=16)
        return Trimesh(fine[0], fine[1], process=True)
    x, y, z = (-centre).tolist()
    placed = solid.translate((x, y, z)).scale((scale, scale, scale))
    if placed.num_tri() > MOST_TRIANGLES:
        raise TronError(f"a part of a shape has {placed.num_tri()} triangles")
    # A square of an edge's length holds a good two triangles.
    longer = max(edge, float(np.sqrt(2.0 * placed.surface_area() / MOST_TRIANGLES)))
    fine = placed.refine_to_length(longer)
    while fine.num_tri() > MOST_TRIANGLES:
        longer *= 1.2
        fine = placed.refine_to_length(longer)
    mesh = fine.to_mesh64()
    return Trimesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), process=False)


def split_creases(mesh: Trimesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shading normals that are smooth over curved parts and break at creases sharper than CREASE_DEG.

    Returns:
        vertices (V, 3), unit normals (V, 3) float64 and faces (F, 3) int; vertices on creases are repeated.
    """
    shaded = trimesh.graph.smooth_shade(mesh, angle=np.radians(CREASE_DEG))
    return np.asarray(shaded.vertices), np.asarray(shaded.vertex_normals), np.asarray(shaded.faces)
