"""Look of a surface at its points: the base of every family of materials."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, NamedTuple, Self

import numpy as np

from datagen.shapes.shape import Role
from datagen.spec import Spec, Triple

BLOCK = 2**14
"""Points evaluated at once: what noise needs in between stays in a core's cache."""

ALBEDO = (0.02, 0.9)
"""Least and greatest linear base color of a procedural dielectric: soot to fresh snow."""

ROUGHNESS = (0.1, 0.95)
"""Least and greatest roughness of a procedural material: mirrors make fireflies at few samples."""


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


class Look(NamedTuple):
    """Appearance as a solid family computes it: base color (3, N) or (3, 1), the others (N,) or numbers."""

    base_color: np.ndarray
    roughness: np.ndarray | float
    metallic: np.ndarray | float
    height: np.ndarray | float


class Solid(Material):
    """Procedural material: a function of the point, and of the normal where it lies on a surface like paper.

    Attributes:
        roles: what it may be made into.
        offset: place of the object within the endless material, world units.
    """

    roles: ClassVar[tuple[Role, ...]] = ()
    offset: Triple

    @classmethod
    @abstractmethod
    def draw(cls, rng: np.random.Generator, role: Role, *, large: bool = False) -> Self:
        """Draw one for a role; ``large``: for a floor or a wall, whose features are larger."""

    @abstractmethod
    def look(self, points: np.ndarray, normals: np.ndarray) -> Look:
        """Appearance at points (3, N) and unit normals (3, N), float32, ``offset`` added to the points."""

    def evaluate(self, points: np.ndarray, normals: np.ndarray) -> Appearance:
        n = len(points)
        color, rough = np.empty((n, 3), np.float32), np.empty(n, np.float32)
        metal, height = np.empty(n, np.float32), np.empty(n, np.float32)
        moved = np.asarray(points, np.float64) + self.offset
        for start in range(0, n, BLOCK):
            part = slice(start, start + BLOCK)
            seen = self.look(
                np.ascontiguousarray(moved[part].T, np.float32),
                np.ascontiguousarray(np.asarray(normals)[part].T, np.float32),
            )
            color[part], metal[part], height[part] = seen.base_color.T, seen.metallic, seen.height
            rough[part] = seen.roughness
        return Appearance(np.clip(color, *ALBEDO), np.clip(rough, *ROUGHNESS), np.clip(metal, 0, 1), height)


def draw_offset(rng: np.random.Generator) -> Triple:
    """A place within the endless material."""
    x, y, z = rng.uniform(0.0, 30.0, 3).tolist()
    return x, y, z
