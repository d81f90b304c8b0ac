"""Wavefront OBJ models as parts: triangles by trimesh, materials by :mod:`tron.models.mtl`.

Images are continued and looked up as their options say. What is clear is cut away as everywhere in
:mod:`tron.models.load`; what cannot be honoured is named in one line a model.
"""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh import Trimesh
from trimesh.visual.color import ColorVisuals

from tron.color import luminance, srgb_to_linear
from tron.errors import TronError, say_once
from tron.io.embedded_colors import colors_of_file
from tron.models.alpha import without_clear
from tron.models.gltf.materials import pixels, require_size, scaled_normals
from tron.models.mtl import MtlMaterial, Texture, find_libraries, joined_lines, read_library
from tron.models.parts import Part, Sampling

LARGEST = 2**30
TEXTURES = ("PNG", "JPEG", "WEBP", "AVIF", "BMP", "TGA", "TIFF", "GIF")
"""Formats of textures."""
_GREY, _ROUGH, _ROUGH_COLORS = 180 / 255, 0.6, 0.7
_CUT = 0.5
_USED = re.compile(r"^[ \t]*usemtl\b[ \t]*(.*?)[ \t]*$", re.MULTILINE)
_LIBRARY = "all.mtl"
_NORMAL_BLUE = 0.6  # mean of the third channel from which on a bump map is one of normals


def read_obj(path: Path, most_triangles: int) -> list[Part]:
    """Parts of an OBJ, one a material, in its own frame and units.

    Raises:
        TronError: it is too large, or a library or texture that it names cannot be read.
    """
    _require_small(path, most_triangles)
    text = joined_lines(path.read_bytes().decode("utf-8", "replace"))
    libraries, missing = find_libraries(path, text)
    notes = [f"library '{name[:80]}' is missing" for name in missing]
    materials: dict[str, MtlMaterial] = {}
    for library in libraries:
        materials = read_library(library) | materials
    used = list(dict.fromkeys(_USED.findall(text)))
    if unknown := [name for name in used if name not in materials]:
        named = ", ".join(f"'{name[:40]}'" for name in unknown[:3])
        notes.append(f"{len(unknown)} of {len(used)} materials are in no library and grey: {named}")
    textures = _Images(path)
    parts = []
    for mesh, name in _meshes(text, used, materials):
        material = None if name is None else materials[name]
        parts += [_part(mesh, material, textures, notes)]
        if material is not None:
            notes += [f"{what} is not honoured" for what in material.left_out]
    if notes:
        say_once(__name__, f"{path}: {'; '.join(dict.fromkeys(notes))}", logging.WARNING)
    return parts


def _require_small(path: Path, most_triangles: int) -> None:
    """Refuse by the file's size and its lines of faces, before any is parsed."""
    size = path.stat().st_size
    if size > LARGEST:
        raise TronError(f"OBJ file of {size >> 20:,} MiB is too large", mend="store it as .glb")
    faces = 0
    with path.open("rb") as file:
        while block := file.read(2**24):
            faces += block.count(b"\nf ")
    if faces > most_triangles:
        raise TronError(f"model has more than {most_triangles:,} triangles", mend="simplify it")


def _meshes(
    text: str, used: Sequence[str], materials: dict[str, MtlMaterial]
) -> list[tuple[Trimesh, str | None]]:
    """Meshes with the names of their materials; None where no library has it."""
    # Numbers stand for names, which may be empty or hold spaces.
    known = {f"m{number}": name for number, name in enumerate(used) if name in materials}
    number_of = {name: number for number, name in enumerate(used)}
    library = "".join(f"newmtl {number}\nKd 1 1 1\n" for number in known)  # names, and nothing else
    text = re.sub(r"^[ \t]*mtllib.*$", "", text, flags=re.MULTILINE)
    text = _USED.sub(lambda found: f"usemtl m{number_of[found[1]]}", text)
    loaded = trimesh.load_scene(
        io.BytesIO(f"mtllib {_LIBRARY}\n{text}".encode()),
        file_type="obj",
        process=False,
        resolver={_LIBRARY: library.encode()},
    )
    meshes = [mesh for mesh in loaded.geometry.values() if isinstance(mesh, Trimesh) and len(mesh.faces)]
    names = [str(getattr(getattr(mesh.visual, "material", None), "name", "")) for mesh in meshes]
    return [(mesh, known.get(name)) for mesh, name in zip(meshes, names, strict=True)]


class _Images:
    """Textures of a model, each decoded once for each use."""

    def __init__(self, model: Path) -> None:
        self._model = model
        self._read: dict[tuple[Path, bool], np.ndarray] = {}

    def stored(self, texture: Texture) -> np.ndarray:
        """(h, w, 3 or 4) float32 in [0, 1], as stored: of what is no colour."""
        return self._of(texture, False)

    def shown(self, texture: Texture) -> np.ndarray:
        """(h, w, 3 or 4) float32 in [0, 1], sRGB whatever the file's colour space is."""
        return self._of(texture, True)

    def _of(self, texture: Texture, managed: bool) -> np.ndarray:
        file = texture.file(self._model)
        if (file, managed) not in self._read:
            try:
                data = file.read_bytes()
                # Only these: Pillow's PostScript reader starts a program.
                with Image.open(io.BytesIO(data), formats=TEXTURES) as image:
                    require_size(image.width, image.height)
                    self._read[file, managed] = _decoded(image, data if managed else None) / np.float32(255)
            except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
                raise TronError(
                    f"texture '{texture.name[:80]}' cannot be read, or is too large", mend="store it as PNG"
                ) from error
        return self._read[file, managed]

    def color(self, texture: Texture) -> np.ndarray:
        """(h, w, 3) linear base color."""
        shown = np.clip(texture.base + texture.gain * self.shown(texture)[..., :3], 0, 1)
        return np.asarray(srgb_to_linear(shown), np.float32)

    def channel(self, texture: Texture) -> np.ndarray:
        """(h, w) float32 of the channel that the texture names; by default alpha if it has some, or grey."""
        stored = self.stored(texture)
        if texture.channel in ("r", "g", "b"):
            value = stored[..., "rgb".index(texture.channel)]
        elif stored.shape[2] == 4 and texture.channel in ("", "m"):
            value = stored[..., 3]
        else:
            value = luminance(stored[..., :3])
        return np.clip(texture.base + texture.gain * value, 0, 1).astype(np.float32)


def _decoded(image: Image.Image, data: bytes | None) -> np.ndarray:
    """(h, w, 3 or 4) uint8 of an opened image, brought to sRGB where its file's bytes are given."""
    if data is None:
        return pixels(image)
    colors = colors_of_file(image, data)
    for note in colors.notes():
        say_once(__name__, f"texture of an OBJ: {note}")
    return colors.srgb(np.asarray(image) if colors.inks else pixels(image))


def _sampling(texture: Texture) -> Sampling:
    """Look-up of an image whose v runs down, at coordinates whose v runs down."""
    (su, sv), (ou, ov) = texture.scale, texture.offset
    matrix = np.array([[su, 0, ou], [0, sv, 1 - sv - ov], [0, 0, 1.0]])
    return Sampling(matrix, "clamp" if texture.clamp else "repeat")


def _part(mesh: Trimesh, material: MtlMaterial | None, images: _Images, notes: list[str]) -> Part:
    uv = getattr(mesh.visual, "uv", None)
    # trimesh follows OpenGL (v = 0 at the bottom); Mitsuba's bitmaps begin at the top.
    uv = None if uv is None else np.column_stack([uv[:, 0], 1.0 - np.asarray(uv)[:, 1]]).astype(np.float32)
    part = Part(
        vertices=np.array(mesh.vertices, np.float64),
        normals=_unit_normals(mesh),
        faces=np.array(mesh.faces),
        uv=uv,
        base_color=np.asarray(srgb_to_linear(np.full(3, _GREY)), np.float32),
        roughness=_ROUGH,
        metallic=0.0,
        normal_map=None,
    )
    if material is None:
        if isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind == "vertex":
            colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0
            part.base_color = np.asarray(srgb_to_linear(colors), np.float32)
            part.roughness = _ROUGH_COLORS
        return part
    return _dressed(part, material, images, notes)


def _dressed(part: Part, material: MtlMaterial, images: _Images, notes: list[str]) -> Part:
    """The part in a material of its library, what is clear cut away."""
    textures = material.textures
    if part.uv is None and textures:
        notes.append(f"{next(iter(textures))} needs texture coordinates, which some triangles lack")
        textures = {}
    look = {"map_kd": "base_color", "map_pr": "roughness", "map_pm": "metallic", "norm": "normal_map"}
    sampling = {look[name]: _sampling(texture) for name, texture in textures.items() if name in look}
    if material.diffuse is not None:
        part.base_color = np.asarray(srgb_to_linear(np.clip(material.diffuse, 0, 1)), np.float32)
    part.roughness = _ROUGH if material.roughness is None else float(np.clip(material.roughness, 0, 1))
    part.metallic = 0.0 if material.metallic is None else float(np.clip(material.metallic, 0, 1))
    alpha, alpha_look = np.full((1, 1), material.opacity, np.float32), Sampling(np.eye(3), "repeat")
    if kd := textures.get("map_kd"):
        # An OBJ's Kd usually stands beside the texture rather than on it, so the texture wins.
        part.base_color = images.color(kd)
        stored = images.stored(kd)
        if stored.shape[2] == 4 and "map_d" not in textures:
            alpha, alpha_look = alpha * stored[..., 3], _sampling(kd)
    if opacity := textures.get("map_d"):
        alpha, alpha_look = alpha * images.channel(opacity), _sampling(opacity)
    if rough := textures.get("map_pr"):
        part.roughness = images.channel(rough)
    if metal := textures.get("map_pm"):
        part.metallic = images.channel(metal)
    if relief := textures.get("norm") or textures.get("bump"):
        stored = images.stored(relief)
        if "norm" in textures or _shows_normals(stored):
            part.normal_map = scaled_normals(np.rint(stored * 255), relief.bump)
            sampling["normal_map"] = _sampling(relief)
        else:
            notes.append("bump map of heights is not honoured")
    part.sampling = sampling
    if alpha.min() >= _CUT:
        return part
    whole = len(part.faces)
    cut = without_clear(replace(part, sampling={"base_color": alpha_look}), alpha, _CUT, None)
    if whole and not len(cut.faces):
        notes.append(
            f"a material of opacity {material.opacity:g} (d, or 1 - Tr) is left out: surfaces are opaque"
        )
    return replace(cut, sampling=sampling)


def _shows_normals(stored: np.ndarray) -> bool:
    """Whether a bump map holds normals, as exporters write them there: coloured, and mostly blue."""
    mean = stored[..., :3].mean((0, 1))
    return bool(mean[2] > _NORMAL_BLUE and mean[2] > mean[:2].max() + 0.1)


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
