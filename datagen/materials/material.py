"""What a surface looks like at its points: the base of every family of materials."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from datagen.spec import Spec


class Appearance(NamedTuple):
    """Parameters of Mitsuba's ``principled`` at N points, float32.

    Attributes:
        base_color: (N, 3) linear in [0, 1].
        roughness, metallic: (N,) in [0, 1].
        height: (N,) relief along the normal in world units; 0 is flat.
    """

    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    height: np.ndarray


class Material(Spec):
    """The specification of one family: its distribution, and its appearance at points.

    Attributes:
        family: name in specifications: a Literal with its default.
    """

    family: str

    def evaluate(self, points: np.ndarray, normals: np.ndarray) -> Appearance:
        """Appearance at points (N, 3) of unit normals (N, 3), the object's frame, world units."""
        raise NotImplementedError
