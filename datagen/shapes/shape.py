"""A shape as data, and the kinds of shapes that there are.

A kind, a size, four proportions and a seed become triangle meshes, a piece for each material.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import trimesh
from trimesh import Trimesh

from datagen.spec import Number, Spec

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
        build: from parameters (4,) and seed to pieces of any size, anywhere, z up.
        upright: it stands as built and only turns about z; otherwise it comes to rest on any side.
        roles: for each slot what it is made of.
    """

    build: Callable[[np.ndarray, int], list[Piece]]
    upright: bool = False
    roles: tuple[Role, ...] = ("any",)


def fit(pieces: list[Piece], size: float, edge: float) -> list[Piece]:
    """Pieces centred at the origin and scaled to a ball of radius ``size``, edges at most ``edge`` long."""
    vertices = np.concatenate([np.asarray(piece.mesh.vertices, np.float64) for piece in pieces])
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    scale = size / np.linalg.norm(vertices - centre, axis=1).max()
    fitted = []
    for mesh, slot in pieces:
        fine = trimesh.remesh.subdivide_to_size(
            (np.asarray(mesh.vertices) - centre) * scale, mesh.faces, edge, max_iter=16
        )
        fitted.append(Piece(Trimesh(fine[0], fine[1], process=True), slot))
    return fitted


def split_creases(mesh: Trimesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shading normals that are smooth over curved parts and break at creases sharper than CREASE_DEG.

    Returns:
        vertices (V, 3), unit normals (V, 3) float64 and faces (F, 3) int; vertices on creases are repeated.
    """
    shaded = trimesh.graph.smooth_shade(mesh, angle=np.radians(CREASE_DEG))
    return np.asarray(shaded.vertices), np.asarray(shaded.vertex_normals), np.asarray(shaded.faces)
