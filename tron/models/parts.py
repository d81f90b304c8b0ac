"""Parts of the user's models: triangles of one material, as Mitsuba takes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
from trimesh import Trimesh

Wrap = Literal["repeat", "mirror", "clamp"]
THINNEST = 1e-12
"""Twice a triangle's area over its longest edge squared, at or below which it is no triangle."""


class Sampling(NamedTuple):
    """Lookup of a texture: at ``matrix`` (3, 3) times a part's (u, v, 1), continued by ``wrap``."""

    matrix: np.ndarray
    wrap: Wrap


@dataclass
class Part:
    """Triangles of one material.

    Attributes:
        vertices, normals: (V, 3) float64, the model's frame; normals are unit shading normals.
        faces: (F, 3) int.
        uv: (V, 2) float32 with v = 0 at the image's top row, or None.
        base_color: (h, w, 3) linear image, (V, 3) linear per vertex, or (3,) linear.
        roughness, metallic: (h, w) image or number.
        normal_map: (h, w, 3) tangent-space normals stored as (n + 1) / 2, y up in the image; or None.
        emission: radiance that the front emits, (h, w, 3) linear image or (3,) linear; None: none.
        tint: (V, 3) linear colours that a base color image is multiplied by, or None.
        sampling: field that holds an image -> how it is looked up; one that is absent repeats at (u, v).
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    base_color: np.ndarray
    roughness: np.ndarray | float
    metallic: np.ndarray | float
    normal_map: np.ndarray | None
    tint: np.ndarray | None = None
    sampling: Mapping[str, Sampling] = field(default_factory=dict)
    emission: np.ndarray | None = None

    def moved(self, matrix: np.ndarray, scale: float = 1.0) -> Part:
        """The part scaled about its origin, then moved by a rigid (4, 4) ``matrix``."""
        rotation = matrix[:3, :3]
        return replace(
            self,
            vertices=self.vertices * scale @ rotation.T + matrix[:3, 3],
            normals=self.normals @ rotation.T,
        )

    def transformed(self, matrix: np.ndarray) -> Part:
        """The part under any invertible affine (4, 4) ``matrix``; mirrored triangles keep their outside."""
        linear = matrix[:3, :3]
        normals = self.normals @ np.linalg.inv(linear)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        faces = self.faces[:, ::-1] if np.linalg.det(linear) < 0 else self.faces
        return replace(self, vertices=self.vertices @ linear.T + matrix[:3, 3], normals=normals, faces=faces)


def outline(parts: Sequence[Part]) -> Trimesh:
    """All parts as one mesh without materials, for placement."""
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets)])
    return Trimesh(vertices, faces, process=False)


def joined(parts: Sequence[Part]) -> Part:
    """Join parts with the same textures into one; vertex indices are offset."""
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    first = parts[0]

    def stacked(name: str) -> np.ndarray | None:
        return None if getattr(first, name) is None else np.concatenate([getattr(p, name) for p in parts])

    per_vertex = {"base_color": stacked("base_color")} if first.base_color.ndim == 2 else {}
    return replace(
        first,
        vertices=stacked("vertices"),
        normals=stacked("normals"),
        faces=np.concatenate([part.faces + offset for part, offset in zip(parts, offsets)]),
        uv=stacked("uv"),
        tint=stacked("tint"),
        **per_vertex,
    )


def without_slivers(part: Part) -> Part:
    """The part without triangles that have no area, and without the vertices that none needs."""
    corners = part.vertices[part.faces]
    edges = np.roll(corners, -1, axis=1) - corners
    longest = (edges**2).sum(axis=2).max(axis=1)
    doubled = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    # What is not finite stays, to be refused.
    faces = part.faces[~(doubled <= THINNEST * longest)]
    used, inverse = np.unique(faces, return_inverse=True)
    if len(used) == len(part.vertices):
        return replace(part, faces=faces)

    def kept(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[used]

    return replace(
        part,
        vertices=part.vertices[used],
        normals=part.normals[used],
        faces=inverse.reshape(faces.shape),
        uv=kept(part.uv),
        tint=kept(part.tint),
        base_color=part.base_color[used] if part.base_color.ndim == 2 else part.base_color,
    )


def split_mirrored(part: Part) -> list[Part]:
    """Separate triangles whose texture is mirrored: there the bitangent points down, so normals flip in y.

    Mitsuba builds the tangent frame from dp/du alone and completes it right-handed.
    """
    if part.normal_map is None or part.uv is None:
        return [part]
    a, b, c = (part.uv[part.faces[:, i]].astype(np.float64) for i in range(3))
    # v runs down, so an unmirrored triangle is clockwise in (u, v).
    mirrored = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0] > 0
    if not mirrored.any():
        return [part]
    flipped = part.normal_map.copy()
    flipped[..., 1] = 1.0 - flipped[..., 1]
    halves = [
        replace(part, faces=part.faces[~mirrored]),
        replace(part, faces=part.faces[mirrored], normal_map=flipped),
    ]
    return [half for half in halves if len(half.faces)]
