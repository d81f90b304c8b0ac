"""Procedural shapes: a specification becomes triangle meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from trimesh import Trimesh

from datagen.shapes.primitives import PRIMITIVES
from datagen.shapes.shape import Kind, Piece, Role, ShapeSpec, fit, split_creases
from datagen.shapes.surroundings import floor
from tron.errors import TronError

__all__ = ["SHAPES", "Kind", "Piece", "Role", "ShapeSpec", "draw_shape", "make_pieces", "split_creases"]


def _solid(build: Callable[[np.ndarray], Trimesh]) -> Kind:
    return Kind(lambda parameters, _seed: [Piece(build(parameters), 0)])


SHAPES: dict[str, Kind] = {
    **{name: _solid(build) for name, build in PRIMITIVES.items()},
    "floor": Kind(floor, upright=True, roles=("ground",)),
}
"""Every kind of shape by its name."""


def draw_shape(rng: np.random.Generator, kinds: Sequence[str], size: tuple[float, float]) -> ShapeSpec:
    """Draw one of ``kinds`` with a radius between the two numbers of ``size``."""
    kind = kinds[int(rng.integers(len(kinds)))]
    return ShapeSpec(kind=kind, size=rng.uniform(*size), parameters=tuple(rng.random(4)))


def make_pieces(shape: ShapeSpec, edge: float = 0.05) -> list[Piece]:
    """Build a shape's pieces, their edges at most ``edge`` world units long.

    Together they just fit the ball of radius ``shape.size`` around the origin of the object's frame; normals
    point outwards. Vertices are shared; :func:`split_creases` gives a mesh its shading normals.

    Raises:
        TronError: no such kind.
    """
    if shape.kind not in SHAPES:
        raise TronError(f"no shape '{shape.kind}'", mend=f"shapes are {', '.join(SHAPES)}")
    return fit(SHAPES[shape.kind].build(np.asarray(shape.parameters), shape.seed), shape.size, edge)
