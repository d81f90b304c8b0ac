"""Procedural shapes: a specification becomes triangle meshes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from datagen.world.shapes.booleans import BOOLEANS
from datagen.world.shapes.cloth import CLOTH
from datagen.world.shapes.displaced import DISPLACED
from datagen.world.shapes.extrusions import EXTRUSIONS
from datagen.world.shapes.furniture import FURNITURE
from datagen.world.shapes.lathes import LATHES
from datagen.world.shapes.plants import PLANTS
from datagen.world.shapes.primitives import PRIMITIVES
from datagen.world.shapes.shape import Kind, Piece, Role, ShapeSpec, fit, frame, split_creases
from datagen.world.shapes.sheets import SHEETS
from datagen.world.shapes.solids import Parts
from datagen.world.shapes.surroundings import SURROUNDINGS, Standing
from datagen.world.shapes.wires import WIRES
from tron.errors import TronError
from tron.seeds import generator

__all__ = [
    "SHAPES",
    "SURROUNDINGS",
    "Kind",
    "Piece",
    "Role",
    "ShapeSpec",
    "Standing",
    "ThingName",
    "draw_shape",
    "make_pieces",
    "split_creases",
    "standing",
]

SHAPES: dict[str, Kind] = {
    **PRIMITIVES,
    **DISPLACED,
    **LATHES,
    **EXTRUSIONS,
    **BOOLEANS,
    **WIRES,
    **PLANTS,
    **CLOTH,
    **SHEETS,
    **FURNITURE,
    **SURROUNDINGS,
}
"""Every kind of shape by its name."""

if TYPE_CHECKING:
    ThingName = str
else:
    ThingName = Literal[tuple(name for name in SHAPES if name not in SURROUNDINGS)]
    """Name of a kind that stands on something."""


def draw_shape(rng: np.random.Generator, kinds: Sequence[str], size: tuple[float, float]) -> ShapeSpec:
    """Draw one of ``kinds`` with a radius between the two numbers of ``size``."""
    kind = kinds[int(rng.integers(len(kinds)))]
    radius, parameters = rng.uniform(*size), tuple(rng.random(4))
    # Kinds without detail of their own take no seed.
    seed = int(rng.integers(2**31)) if SHAPES[kind].seeded else 0
    return ShapeSpec(kind=kind, size=radius, parameters=parameters, seed=seed)


def make_pieces(shape: ShapeSpec, edge: float = 0.05) -> list[Piece]:
    """Build a shape's pieces with edges of at most ``edge`` world units.

    Together they just fit the ball of radius ``shape.size`` around the origin of the object's frame; normals
    point outwards. Vertices are shared; :func:`split_creases` gives a mesh its shading normals. A piece
    that manifold3d made (all but the primitives and the floor) has at most 60,000 triangles: the edges of a
    large one are longer.

    Raises:
        TronError: no such kind, or its parameters make nothing solid.
    """
    return fit(_parts(shape), shape.size, edge)


def standing(shape: ShapeSpec) -> Standing:
    """Return the free space over a support, in the object's frame.

    Raises:
        TronError: no such kind, or nothing stands on it.
    """
    if shape.kind in SHAPES and shape.kind not in SURROUNDINGS:
        raise TronError(f"nothing stands on a shape '{shape.kind}'")
    centre, scale = frame(_parts(shape), shape.size)
    space = SURROUNDINGS[shape.kind].standing(np.asarray(shape.parameters), _stream(shape))
    return space.moved(centre, scale)


def _parts(shape: ShapeSpec) -> Parts:
    if shape.kind not in SHAPES:
        raise TronError(f"no shape '{shape.kind}'", mend=f"shapes are {', '.join(SHAPES)}")
    return SHAPES[shape.kind].build(np.asarray(shape.parameters), _stream(shape))


def _stream(shape: ShapeSpec) -> np.random.Generator:
    return generator(shape.seed, "shape", shape.kind)
