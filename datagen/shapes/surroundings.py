"""What stands still around the objects: the floor that they rest on."""

from __future__ import annotations

import numpy as np
from trimesh import Trimesh

from datagen.shapes.shape import Piece


def floor(_parameters: np.ndarray, _seed: int) -> list[Piece]:
    """A square in the plane z = 0; its half side is its size over the root of two."""
    corners = [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]
    return [Piece(Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False), 0)]
