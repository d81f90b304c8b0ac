"""The user's glTF, GLB and OBJ models as textured parts that surfels can represent.

Textures become linear float32 images; the glTF metallic-roughness model maps one to one onto Mitsuba's
``principled``. Surfels and shadow rays know opaque surfaces only, so transparency is decided once, here:
what is below the cut-off of alpha (one half where the material blends) is cut away, the rest becomes
opaque. Path tracer, G-buffers and reference then agree on what is there.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh import Trimesh
from trimesh.visual.color import ColorVisuals

from datagen.alpha import without_clear
from datagen.gltf.document import confined
from datagen.gltf.images import pixels, require_size
from datagen.gltf.meshes import read_parts
from datagen.parts import Part, split_mirrored, without_slivers
from tron.color import srgb_to_linear
from tron.errors import TronError

SUFFIXES = (".gltf", ".glb", ".obj")
MOST_TRIANGLES = 5_000_000
LARGEST_OBJ = 2**30
LARGEST_MTL = 2**20
TEXTURES = ("PNG", "JPEG", "WEBP", "AVIF", "BMP", "TGA", "TIFF", "GIF")
"""Formats of an OBJ's textures."""

NEEDLE = 1e-3
"""Least width over length of a model: below it no pixel and no surfel would find it."""

_Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def load_model(path: str | Path, up: str = "y") -> list[Part]:
    """Read a model; it comes out standing (z up) and fitted into the unit ball around the origin.

    Args:
        path: .gltf, .glb or .obj.
        up: the file's own up axis, ``y`` (glTF's rule, OBJ's habit) or ``z``.

    Raises:
        TronError: a file that is missing, damaged, too large, refers to what lies outside its folder, needs
            what is not read, or has nothing to show.
    """
    path = Path(path)
    if not path.is_file():
        raise TronError("model not found", path)
    try:
        parts = _read_obj(path) if path.suffix.lower() == ".obj" else read_parts(path, MOST_TRIANGLES)
        return _fitted(parts, up)
    except TronError as error:
        raise TronError(error.what, error.where or path, error.mend) from error
    except Exception as error:  # trimesh, DracoPy and damaged JSON raise whatever they stumble over
        raise TronError(f"model cannot be read: {type(error).__name__}: {error}", path) from error


def _fitted(parts: list[Part], up: str) -> list[Part]:
    """Parts with area, z up, in the unit ball."""
    with np.errstate(all="ignore"):  # overflow is found below
        parts = [part for part in map(without_slivers, parts) if len(part.faces)]
    if not parts:
        raise TronError("model has no opaque triangles")
    if sum(len(part.faces) for part in parts) > MOST_TRIANGLES:
        raise TronError(f"model has more than {MOST_TRIANGLES:,} triangles", mend="simplify it")
    if not all(np.isfinite(part.vertices).all() for part in parts):
        raise TronError("model has vertices that are not finite")
    if any(part.uv is not None and not np.isfinite(part.uv).all() for part in parts):
        raise TronError("model has texture coordinates that are not finite")
    turn = _Y_UP_TO_Z_UP if up == "y" else np.eye(3)
    parts = [replace(p, vertices=p.vertices @ turn.T, normals=p.normals @ turn.T) for p in parts]
    used = np.concatenate([part.vertices for part in parts])
    centre = 0.5 * used.min(axis=0) + 0.5 * used.max(axis=0)
    with np.errstate(over="ignore"):
        radius = float(np.linalg.norm(used - centre, axis=1).max())
    if not 0 < radius < np.inf:
        raise TronError("model has no extent, or more than numbers hold")
    parts = [replace(part, vertices=(part.vertices - centre) / radius) for part in parts]
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(((used - centre) / radius).T)), 0.0))
    if spread[1] < NEEDLE * spread[2]:
        raise TronError(f"model is {spread[2] / max(spread[1], 1e-30):,.0f} times longer than wide: a needle")
    return [piece for part in parts for piece in split_mirrored(part)]


def _read_obj(path: Path) -> list[Part]:
    _require_small_obj(path)
    scene = trimesh.load_scene(path, process=False)
    _require_textures(scene, path)
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, Trimesh) and len(mesh.faces):
            parts.append(_obj_part(mesh).transformed(np.asarray(transform)))
    return parts


def _require_small_obj(path: Path) -> None:
    """Refuse by the file's size and its lines of faces, before any is parsed."""
    size = path.stat().st_size
    if size > LARGEST_OBJ:
        raise TronError(f"OBJ file of {size >> 20:,} MiB is too large", mend="store it as .glb")
    faces = 0
    with path.open("rb") as file:
        while block := file.read(2**24):
            faces += block.count(b"\nf ")
    if faces > MOST_TRIANGLES:
        raise TronError(f"model has more than {MOST_TRIANGLES:,} triangles", mend="simplify it")


def _require_textures(scene: trimesh.Scene, path: Path) -> None:
    """Refuse an OBJ whose materials name textures that trimesh, silently, did not read."""
    named: dict[str, str] = {}
    with path.open("rb") as file:
        library = next((line.split(None, 1)[1].strip() for line in file if line.startswith(b"mtllib ")), None)
    if library is not None:
        source = confined(path, library.decode("utf-8", "replace"))
        if source.stat().st_size > LARGEST_MTL:
            raise TronError(f"material library of {source.stat().st_size >> 20} MiB is too large")
        material = ""
        for line in source.read_text("utf-8", "replace").splitlines():
            key, _, value = line.strip().partition(" ")
            if key.lower() == "newmtl":
                material = value.strip()
            elif key.lower() == "map_kd":
                named[material] = value.strip()
    for mesh in scene.geometry.values():
        material = getattr(mesh.visual, "material", None)
        name = named.get(str(getattr(material, "name", "")))
        if name is not None and getattr(material, "image", None) is None:
            raise TronError(f"texture '{name[:80]}' cannot be read, or lies outside the model's folder")


def _obj_part(mesh: Trimesh) -> Part:
    uv = getattr(mesh.visual, "uv", None)
    # trimesh follows OpenGL (v = 0 at the bottom); Mitsuba's bitmaps begin at the top.
    uv = None if uv is None else np.column_stack([uv[:, 0], 1.0 - np.asarray(uv)[:, 1]]).astype(np.float32)
    base_color, alpha, roughness = _obj_textures(mesh, uv is not None)
    part = Part(
        vertices=np.array(mesh.vertices, np.float64),
        normals=_unit_normals(mesh),
        faces=np.array(mesh.faces),
        uv=uv,
        base_color=base_color,
        roughness=roughness,
        metallic=0.0,
        normal_map=None,
    )
    return part if alpha is None else without_clear(part, alpha, 0.5, None)


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


def _obj_textures(mesh: Trimesh, has_uv: bool) -> tuple[np.ndarray, np.ndarray | None, float]:
    """base color, alpha image or None, and roughness of a mesh's material."""
    if isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind == "vertex":
        colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0
        return np.asarray(srgb_to_linear(colors), np.float32), None, 0.7
    material: Any = getattr(mesh.visual, "material", None)
    # An OBJ's Kd usually stands beside the texture rather than on it, so the texture wins.
    image: Image.Image | None = getattr(material, "image", None)
    if image is not None and has_uv:
        if image.format not in TEXTURES:  # Pillow's PostScript reader starts a program
            raise TronError(f"texture is {image.format}, which is not read", mend="store it as PNG")
        require_size(image.width, image.height)
        stored = pixels(image) / np.float32(255.0)
        alpha = stored[..., 3] if stored.shape[2] == 4 else None
        return np.asarray(srgb_to_linear(stored[..., :3]), np.float32), alpha, 0.6
    diffuse = np.asarray(getattr(material, "diffuse", (180, 180, 180)), np.float64)[:3] / 255.0
    return np.asarray(srgb_to_linear(diffuse), np.float32), None, 0.6
