"""The user's glTF, GLB and OBJ models as textured parts that surfels can represent.

Textures become linear float32 images; the glTF metallic-roughness model maps one to one onto Mitsuba's
``principled``. Surfels and shadow rays know opaque surfaces only, so transparency is decided once, here:
triangles whose alpha is below the cut-off (one half where the material blends) are left out, the others
become opaque. Path tracer, G-buffers and reference then agree on what is there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh import Trimesh
from trimesh.visual.color import ColorVisuals
from trimesh.visual.material import PBRMaterial

from tron.color import srgb_to_linear
from tron.errors import TronError

SUFFIXES = (".gltf", ".glb", ".obj")
MOST_TRIANGLES = 5_000_000
LARGEST_TEXTURE = 8192 * 8192
_Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


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
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    base_color: np.ndarray
    roughness: np.ndarray | float
    metallic: np.ndarray | float
    normal_map: np.ndarray | None

    def moved(self, matrix: np.ndarray, scale: float = 1.0) -> Part:
        """The part scaled about its origin, then moved by a rigid (4, 4) ``matrix``."""
        rotation = matrix[:3, :3]
        return replace(
            self,
            vertices=self.vertices * scale @ rotation.T + matrix[:3, 3],
            normals=self.normals @ rotation.T,
        )


def load_model(path: str | Path, up: str = "y") -> list[Part]:
    """Read a model; it comes out standing (z up) and fitted into the unit ball around the origin.

    Args:
        path: .gltf, .glb or .obj.
        up: the file's own up axis, ``y`` (glTF's rule, OBJ's habit) or ``z``.

    Raises:
        TronError: missing or unreadable file, no triangles, too many, or values that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise TronError("model not found", path)
    try:
        scene = trimesh.load_scene(path, process=False)
        parts = [part for node in scene.graph.nodes_geometry for part in _node_parts(scene, node)]
    except TronError as error:
        raise TronError(error.what, path, error.mend) from error
    except Exception as error:  # trimesh and Pillow raise whatever their parsers stumble over
        raise TronError(f"model cannot be read: {type(error).__name__}: {error}", path) from error
    if not parts:
        raise TronError("model has no opaque triangles", path)
    if sum(len(part.faces) for part in parts) > MOST_TRIANGLES:
        raise TronError(f"model has more than {MOST_TRIANGLES:,} triangles", path, "simplify it")
    if not all(np.isfinite(part.vertices).all() for part in parts):
        raise TronError("model has vertices that are not finite", path)
    turn = _Y_UP_TO_Z_UP if up == "y" else np.eye(3)
    parts = [replace(p, vertices=p.vertices @ turn.T, normals=p.normals @ turn.T) for p in parts]
    used = np.concatenate([part.vertices[np.unique(part.faces)] for part in parts])
    centre = 0.5 * (used.min(axis=0) + used.max(axis=0))
    radius = float(np.linalg.norm(used - centre, axis=1).max())
    if not radius > 0:
        raise TronError("model has no extent", path)
    return [replace(part, vertices=(part.vertices - centre) / radius) for part in parts]


def outline(parts: list[Part]) -> Trimesh:
    """All parts as one mesh without materials, for placement."""
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets)])
    return Trimesh(vertices, faces, process=False)


def _node_parts(scene: trimesh.Scene, node: str) -> list[Part]:
    transform, name = scene.graph[node]
    mesh = scene.geometry[name]
    if not isinstance(mesh, Trimesh) or len(mesh.faces) == 0:
        return []
    uv = getattr(mesh.visual, "uv", None)
    # trimesh follows OpenGL (v = 0 at the bottom); Mitsuba's bitmaps begin at the top.
    uv = None if uv is None else np.column_stack([uv[:, 0], 1.0 - np.asarray(uv)[:, 1]]).astype(np.float32)
    normals = _unit_normals(mesh)
    base_color, alpha, roughness, metallic, normal_map = _textures(mesh, uv is not None)
    part = Part(
        vertices=np.array(mesh.vertices, np.float64),
        normals=normals,
        faces=np.array(mesh.faces),
        uv=uv,
        base_color=base_color,
        roughness=roughness,
        metallic=metallic,
        normal_map=normal_map,
    )
    if alpha is not None:
        part.faces = part.faces[_face_alpha(part, alpha) >= _cutoff(getattr(mesh.visual, "material", None))]
    linear = np.asarray(transform)[:3, :3]
    part.vertices = part.vertices @ linear.T + np.asarray(transform)[:3, 3]
    part.normals = part.normals @ np.linalg.inv(linear)
    part.normals /= np.maximum(np.linalg.norm(part.normals, axis=1, keepdims=True), 1e-12)
    if np.linalg.det(linear) < 0:
        part.faces = part.faces[:, ::-1]
    return [piece for piece in _split_mirrored(part) if len(piece.faces)]


def _unit_normals(mesh: Trimesh) -> np.ndarray:
    normals = np.array(mesh.vertex_normals, np.float64)
    length = np.linalg.norm(normals, axis=1)
    bad = ~(length > 1e-6)
    if bad.any():
        own = trimesh.geometry.mean_vertex_normals(len(mesh.vertices), mesh.faces, mesh.face_normals)
        normals[bad], length[bad] = (
            np.where(np.linalg.norm(own[bad], axis=1)[:, None] > 0, own[bad], (0, 0, 1)),
            1.0,
        )
    return normals / length[:, None]


def _textures(mesh: Trimesh, has_uv: bool) -> tuple[np.ndarray, Any, Any, Any, np.ndarray | None]:
    """base color, alpha image or None, roughness, metallic, normal map of a mesh's material."""
    if isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind == "vertex":
        colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0
        return np.asarray(srgb_to_linear(colors), np.float32), None, 0.7, 0.0, None
    material = getattr(mesh.visual, "material", None)
    if isinstance(material, PBRMaterial):
        return _pbr_textures(material, has_uv)
    # An OBJ's Kd usually stands beside the texture rather than on it, so the texture wins.
    image = getattr(material, "image", None)
    if image is not None and has_uv:
        return np.asarray(srgb_to_linear(_pixels(image, "RGB")), np.float32), _alpha(image), 0.6, 0.0, None
    diffuse = np.asarray(getattr(material, "diffuse", (180, 180, 180)), np.float64)[:3] / 255.0
    return np.asarray(srgb_to_linear(diffuse), np.float32), None, 0.6, 0.0, None


def _pbr_textures(material: PBRMaterial, has_uv: bool) -> tuple[np.ndarray, Any, Any, Any, np.ndarray | None]:
    factor = material.baseColorFactor
    # trimesh stores the linear factor in bytes.
    factor = np.ones(4) if factor is None else np.asarray(factor, np.float64) / 255.0
    base: np.ndarray = factor[:3].astype(np.float32)
    alpha = None
    if has_uv and material.baseColorTexture is not None:
        base = np.asarray(srgb_to_linear(_pixels(material.baseColorTexture, "RGB")) * factor[:3], np.float32)
        alpha = _alpha(material.baseColorTexture)
    if material.alphaMode in (None, "OPAQUE"):
        alpha = None
    elif alpha is None and factor[3] < 1.0:
        alpha = np.full((1, 1), factor[3])
    roughness: Any = 1.0 if material.roughnessFactor is None else float(material.roughnessFactor)
    metallic: Any = 1.0 if material.metallicFactor is None else float(material.metallicFactor)
    if has_uv and material.metallicRoughnessTexture is not None:
        packed = _pixels(material.metallicRoughnessTexture, "RGB")
        roughness, metallic = roughness * packed[..., 1], metallic * packed[..., 2]
    normal = None
    if has_uv and material.normalTexture is not None:
        normal = _pixels(material.normalTexture, "RGB")
    return base, alpha, roughness, metallic, normal


def _pixels(image: Image.Image, mode: str) -> np.ndarray:
    """(h, w, C) float32 in [0, 1], top row first, as stored (no colour conversion)."""
    if image.width * image.height > LARGEST_TEXTURE:
        raise TronError(f"texture of {image.width} x {image.height} pixels is too large", mend="shrink it")
    pixels = np.asarray(image.convert(mode), np.float32) / 255.0
    return pixels if pixels.ndim == 3 else pixels[..., None]


def _alpha(image: Image.Image) -> np.ndarray | None:
    return _pixels(image, "RGBA")[..., 3] if "A" in image.getbands() else None


def _cutoff(material: Any) -> float:
    cutoff = getattr(material, "alphaCutoff", None)
    return float(cutoff) if getattr(material, "alphaMode", None) == "MASK" and cutoff is not None else 0.5


def _face_alpha(part: Part, alpha: np.ndarray) -> np.ndarray:
    """(F,) mean alpha at each triangle's centre and halfway to its corners."""
    if part.uv is None:
        return np.full(len(part.faces), float(alpha.mean()))
    corners = part.uv[part.faces]
    centre = corners.mean(axis=1, keepdims=True)
    uv = np.concatenate([centre, 0.5 * (corners + centre)], axis=1) % 1.0
    rows = np.minimum((uv[..., 1] * alpha.shape[0]).astype(int), alpha.shape[0] - 1)
    columns = np.minimum((uv[..., 0] * alpha.shape[1]).astype(int), alpha.shape[1] - 1)
    return alpha[rows, columns].mean(axis=1)


def _split_mirrored(part: Part) -> list[Part]:
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
    return [
        replace(part, faces=part.faces[~mirrored]),
        replace(part, faces=part.faces[mirrored], normal_map=flipped),
    ]
