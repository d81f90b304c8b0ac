"""Contents of the user's files, by hash: two files under two names may be one model, texture or map.

A model has the hashes of its file, of the files that it refers to, of its triangles and of each image on
them. So a copy under another name, in another format or with other textures is found by a shared hash.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote

import numpy as np
from PIL import Image
from pydantic import BaseModel, ConfigDict

from tron.errors import TronError
from tron.io.gltf_document import confined, read_document
from tron.models.gltf.materials import require_size
from tron.models.mtl import find_libraries, joined_lines, read_library
from tron.models.parts import Part
from tron.storage import sha256

ContentKind = Literal["model", "buffer", "library", "mesh", "texture", "plain", "map"]
_UNCOMPARED = ("library", "plain")
_READ = ("PNG", "JPEG", "WEBP", "AVIF", "BMP", "TGA", "TIFF", "GIF")
_IMAGES = ("base_color", "roughness", "metallic", "normal_map")


class Content(BaseModel):
    """Hash of a part of an asset.

    Attributes:
        path: relative to the folder; what was decoded from a file is named behind a ``#``.
        kind: what it is; a ``library`` (an OBJ's .mtl) is neither mesh, texture nor map, and a ``plain``
            image of a single colour is nobody's: neither tells that two things share anything.
        sha256: 64 hexadecimal digits.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: str
    kind: ContentKind
    sha256: str


def compared(contents: Sequence[Content]) -> frozenset[str]:
    """Hashes that count as shared between two assets."""
    return frozenset(each.sha256 for each in contents if each.kind not in _UNCOMPARED)


def model_contents(folder: Path, path: str, parts: Sequence[Part]) -> tuple[Content, ...]:
    """Return the contents of a model: its file, the files beside it, its triangles and its images.

    Args:
        folder: of the assets.
        path: of the model, relative to it.
        parts: the model as :func:`tron.models.load.load_model` gives it.
    """
    found = [Content(path=path, kind="model", sha256=sha256(folder / path))]
    for file, kind in _references(folder / path):
        name = file.relative_to(folder.resolve()).as_posix()
        kind = texture_kind(file) if kind == "texture" else kind
        found.append(Content(path=name, kind=kind, sha256=sha256(file)))
    found.append(Content(path=f"{path}#mesh", kind="mesh", sha256=_mesh_hash(parts)))
    images = [_image_hash(image) for image in _images(parts)]
    found += [
        Content(path=f"{path}#texture{i}", kind="texture", sha256=digest)
        for i, digest in enumerate(dict.fromkeys(images))
    ]
    return tuple(dict.fromkeys(found))


def _references(path: Path) -> Iterator[tuple[Path, ContentKind]]:
    """Yield the files that a model refers to, with links followed; missing ones are left to its reader."""
    named: list[tuple[str, ContentKind]] = []
    if path.suffix.lower() == ".obj":
        yield from _of_obj(path)
    else:
        tree = read_document(path).tree
        kinds: dict[str, ContentKind] = {"buffers": "buffer", "images": "texture"}
        for key, kind in kinds.items():
            uris = [entry.get("uri") for entry in tree.get(key, []) if isinstance(entry, dict)]
            own = (unquote(uri) for uri in uris if isinstance(uri, str) and not uri.startswith("data:"))
            for uri in own:
                named.append((uri, kind))
    for name, kind in named:
        try:
            file = confined(path, name)
        except TronError:
            continue
        yield file, kind


def _of_obj(path: Path) -> Iterator[tuple[Path, ContentKind]]:
    for library in find_libraries(path, joined_lines(path.read_bytes().decode("utf-8", "replace")))[0]:
        yield library, "library"
        for material in read_library(library).values():
            for texture in material.textures.values():
                try:
                    yield texture.file(path), "texture"
                except TronError:
                    continue


def texture_kind(path: Path) -> ContentKind:
    """Return ``plain`` for an image of one colour, such as a flat normal map; unreadable: texture."""
    try:
        with Image.open(path, formats=_READ) as image:
            require_size(image.width, image.height)
            ranges = np.atleast_2d(image.getextrema())
    except (OSError, SyntaxError, ValueError, TronError, Image.DecompressionBombError):
        return "texture"
    return "plain" if (ranges[:, 0] == ranges[:, 1]).all() else "texture"


def _mesh_hash(parts: Sequence[Part]) -> str:
    """Hash all triangles as float32 in a canonical order, without materials."""
    corners = [np.asarray(part.vertices, np.float32)[np.asarray(part.faces)] for part in parts]
    rows = np.concatenate(corners).reshape(-1, 9) + np.float32(0.0)
    return hashlib.sha256(np.ascontiguousarray(rows[np.lexsort(rows.T)]).tobytes()).hexdigest()


def _images(parts: Sequence[Part]) -> list[np.ndarray]:
    """Return the images on the parts, except images of a single colour."""
    found: dict[int, Any] = {}
    for part in parts:
        for name in _IMAGES:
            value = getattr(part, name)
            pictured = np.ndim(value) == (2 if name in ("roughness", "metallic") else 3)
            if (
                pictured
                and np.ptp(value.reshape(-1, value.shape[-1] if value.ndim == 3 else 1), axis=0).any()
            ):
                found[id(value)] = value
    return list(found.values())


def _image_hash(image: np.ndarray) -> str:
    shape = ",".join(map(str, image.shape)).encode()
    return hashlib.sha256(shape + np.ascontiguousarray(image, np.float32).tobytes()).hexdigest()
