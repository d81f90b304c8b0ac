"""Look of a surface at its points: the base of every family of materials, and what families share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol, Self

import numpy as np

from datagen.world.shapes.shape import Role
from datagen.world.spec import Spec, Triple

BLOCK = 2**14
"""Points evaluated at once: what noise needs in between stays in a core's cache."""

ALBEDO = (0.02, 0.9)
"""Least and greatest linear base color of a procedural dielectric: soot to fresh snow."""

ROUGHNESS = (0.1, 0.95)
"""Least and greatest roughness of a procedural material: mirrors make fireflies at few samples."""


class Appearance(NamedTuple):
    """Parameters of :mod:`tron.brdf` at N points, float32.

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


class Evaluated(Protocol):
    """Source of the look at points (N, 3) of unit normals (N, 3)."""

    def evaluate(self, points: np.ndarray, normals: np.ndarray) -> Appearance: ...


@dataclass(frozen=True)
class Unsaid:
    """A material of a file that names its base color and relief alone: metal of roughness 1 (glTF 2.0)."""

    of: Evaluated

    def evaluate(self, points: np.ndarray, normals: np.ndarray) -> Appearance:
        """See :meth:`Material.evaluate`."""
        seen = self.of.evaluate(points, normals)
        return seen._replace(roughness=np.ones_like(seen.roughness), metallic=np.ones_like(seen.metallic))


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


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Hermite's step from 0 at ``low`` to 1 at ``high``; falling where ``low`` is the greater."""
    t = np.clip((x - np.float32(low)) * np.float32(1.0 / (high - low)), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def mix(a: np.ndarray | float, b: np.ndarray | float, t: np.ndarray | float) -> np.ndarray:
    """a where t is 0, b where it is 1."""
    return np.asarray(a + (b - a) * t, np.float32)


def column(color: Triple) -> np.ndarray:
    """A colour (3, 1) that broadcasts over points (3, N)."""
    return np.asarray(color, np.float32)[:, None]


def near(rng: np.random.Generator, palette: Sequence[Triple], spread: float = 0.15) -> Triple:
    """A linear colour near one of a palette: brightness varies by ``spread``, each channel by a third of it.

    The variation is in the logarithm, so dark colours stay dark and hues stay what they are.
    """
    chosen = np.asarray(palette[int(rng.integers(len(palette)))], np.float64)
    scale = np.exp(spread * rng.uniform(-1.0, 1.0) + spread / 3.0 * rng.uniform(-1.0, 1.0, 3))
    r, g, b = np.clip(chosen * scale, 0.02, 0.88).tolist()
    return r, g, b


def darker(color: Triple, factor: float) -> Triple:
    """The colour times ``factor``."""
    r, g, b = color
    return r * factor, g * factor, b * factor


def turned(points: np.ndarray, axis: Triple) -> np.ndarray:
    """Points (3, N) in a right-handed frame whose third axis is the unit vector ``axis``."""
    third = np.asarray(axis, np.float64)
    helper = np.eye(3)[int(np.argmin(np.abs(third)))]
    first = np.cross(helper, third)
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(third, first), third]).astype(np.float32)
    return frame @ points


def laid(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates u, v (N,) of a flat pattern on the side that a surface faces most, and that side (N,).

    On walls v is up; on floors u and v are x and y.
    """
    side = np.argmax(np.abs(normals), axis=0)
    u = np.where(side == 0, points[1], points[0])
    v = np.where(side == 2, points[1], points[2])
    return u, v, side


def direction(rng: np.random.Generator, flat: bool = False) -> Triple:
    """A unit vector; in the plane of x and y where ``flat``."""
    drawn = rng.normal(size=3)
    if flat:
        drawn[2] = 0.0
    x, y, z = (drawn / np.linalg.norm(drawn)).tolist()
    return x, y, z
