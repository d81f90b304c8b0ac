"""A user's PBR texture set on a surface, repeated and laid on from three sides (triplanar).

Its relief is the height whose slopes are the set's normal map, found by Frankot and Chellappa, "A method for
enforcing integrability in shape from shading algorithms" (1988), whose Fourier series suits what repeats.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, Self

import numpy as np

from datagen.world.materials.material import Appearance, Material, draw_offset
from datagen.world.shapes.shape import Role
from datagen.world.spec import Number, Triple, between

BLEND = 6.0
"""Power of the normal's components that sides are blended by: 1 at a side, edges an eighth of a turn wide."""

FAINTEST = 0.02
"""Share of a side below which it is not looked up."""


class PhotographedSpec(Material):
    """One of the user's texture sets.

    Attributes:
        texture_set: its id.
        sha256: of its files' hashes, in order of what they are (albedo, ao, height, ...).
        repeat: world units that the width of its images covers.
        offset: where the images begin, world units.
    """

    family: Literal["photographed"] = "photographed"
    texture_set: str
    sha256: str
    repeat: Number
    offset: Triple

    @classmethod
    def draw(cls, rng: np.random.Generator, texture_set: str, sha256: str) -> Self:
        """Draw size and place of a set."""
        return cls(
            texture_set=texture_set, sha256=sha256, repeat=between(rng, 0.8, 2.0), offset=draw_offset(rng)
        )


class Named(Protocol):
    """What a file is called by: its id, and the hash of its files' hashes."""

    @property
    def id(self) -> str: ...
    @property
    def sha256(self) -> str: ...


class Offered(Protocol):
    """A texture set that pieces may be dressed with: who it is, and what it is made of by its name."""

    @property
    def asset(self) -> Named: ...
    @property
    def role(self) -> Role: ...


def dressed(
    material: Material, role: Role, sets: Sequence[Offered], share: float, rng: np.random.Generator
) -> Material:
    """The material, or by chance ``share`` one of the sets that suit its role; a leaf takes no bricks."""
    suited = [each for each in sets if role in ("any", each.role) or each.role == "any"]
    if not suited or rng.random() >= share:
        return material
    chosen = suited[int(rng.integers(len(suited)))].asset
    return PhotographedSpec.draw(rng, chosen.id, chosen.sha256)


@dataclass(frozen=True)
class Photographed:
    """A set with its images, as it is looked up.

    Attributes:
        spec: how it is laid on.
        image: (h, w, 6) float32: linear base color, roughness, metallic, and height in widths of the image.
    """

    spec: PhotographedSpec
    image: np.ndarray

    def evaluate(self, points: np.ndarray, normals: np.ndarray) -> Appearance:
        """Appearance at points (N, 3) of unit normals (N, 3), the object's frame, world units."""
        share = np.abs(normals) ** BLEND
        share = np.where(share < FAINTEST * share.max(axis=1, keepdims=True), 0.0, share)
        share = (share / share.sum(axis=1, keepdims=True)).astype(np.float32)
        place = (points + self.spec.offset) / self.spec.repeat
        total = np.zeros((len(points), self.image.shape[2]), np.float32)
        # Up is z on walls and y on floors; right is right for who looks at the side from without.
        for axis, (right, up, sign) in enumerate(((1, 2, 1.0), (0, 2, -1.0), (0, 1, 1.0))):
            here = np.flatnonzero(share[:, axis])
            side = sign * np.where(normals[here, axis] < 0.0, -1.0, 1.0)
            total[here] += share[here, axis, None] * self._look_up(
                side * place[here, right], -place[here, up]
            )
        return Appearance(total[:, :3], total[:, 3], total[:, 4], total[:, 5] * np.float32(self.spec.repeat))

    def _look_up(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Bilinear values (N, C) where the image's width is 1, v downwards; it repeats."""
        height, width = self.image.shape[:2]
        x, y = u * width - 0.5, v * width - 0.5
        left, top = np.floor(x), np.floor(y)
        fx, fy = ((x - left)[:, None]).astype(np.float32), ((y - top)[:, None]).astype(np.float32)
        x0, y0 = left.astype(np.int64) % width, top.astype(np.int64) % height
        x1, y1 = (x0 + 1) % width, (y0 + 1) % height
        above = self.image[y0, x0] * (1 - fx) + self.image[y0, x1] * fx
        return above * (1 - fy) + (self.image[y1, x0] * (1 - fx) + self.image[y1, x1] * fx) * fy


def height_from_normals(normals: np.ndarray) -> np.ndarray:
    """Height (h, w), in widths of the image, mean 0, of a repeating map of unit normals (h, w, 3), y up."""
    height, width = normals.shape[:2]
    z = np.maximum(normals[..., 2], 0.1)
    across, down = np.fft.fft2(-normals[..., 0] / z), np.fft.fft2(normals[..., 1] / z)
    wx = 2.0 * np.pi * np.fft.fftfreq(width, 1.0 / width)[None, :]
    wy = 2.0 * np.pi * np.fft.fftfreq(height, 1.0 / width)[:, None]
    square = wx * wx + wy * wy
    square[0, 0] = 1.0
    series = -1j * (wx * across + wy * down) / square
    series[0, 0] = 0.0
    return np.fft.ifft2(series).real.astype(np.float32)
