"""The user's folder of PBR texture sets: which images belong together, what they mean, and their licence.

A set is what shares a folder and the beginning of its files' names; the end says which map a file is, as on
Poly Haven (``wood_floor_diff_2k.jpg``, ``wood_floor_arm_2k.jpg``, ``wood_floor_nor_gl_2k.exr``) and on
ambientCG (``Bricks092_2K-JPG_Color.jpg``, ``..._NormalGL.jpg``, ``..._Roughness.jpg``).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from datagen.files.assets import CATALOGUE_NAME, Asset, read_catalogue, require_licences
from datagen.files.contents import Content, texture_kind
from datagen.world.materials.photographed import Photographed, PhotographedSpec, height_from_normals
from datagen.world.shapes.shape import Role
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.io.images import read_image
from tron.storage import sha256

SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")

_WORDS: dict[str, tuple[str, ...]] = {
    "albedo": ("albedo", "basecolor", "diffuse", "diff", "color", "colour", "col"),
    "roughness": ("roughness", "rough"),
    "metallic": ("metallic", "metalness", "metal"),
    "normal": ("normal", "nor", "normalgl", "normaldx", "nrm"),
    "height": ("height", "displacement", "disp"),
    "ao": ("ao", "ambientocclusion", "occlusion"),
    "packed": ("arm", "orm"),
}
_KINDS = {word: kind for kind, words in _WORDS.items() for word in words}
_SIDE_WORDS = re.compile(r"\d+k|\d+bit|jpe?g|png|exr|tiff?|gl|dx|opengl|directx")
_DIRECTX = {"dx", "directx", "normaldx"}

RELIEF = 0.03
"""Height from black to white, in widths of the image, of a set with a height map and without normals."""

SETS_KEPT = 4
"""Images kept for the next piece: a thousand pixels a side take 24 MB, and scenes want sizes of their own."""

PLAIN_ROUGHNESS = 0.7
"""Roughness of a set that has none."""

_ROLE_WORDS: dict[Role, tuple[str, ...]] = {
    "wood": ("wood", "plank", "parquet", "veneer"),
    "stone": ("stone", "rock", "marble", "granite", "slate", "concrete"),
    "brick": ("brick",),
    "fabric": ("fabric", "textile", "cloth", "wool", "denim", "carpet", "cotton", "linen"),
    "tiles": ("tile",),
    "metal": ("metal", "rust", "steel", "copper", "iron"),
    "ceramic": ("ceramic", "porcelain"),
    "plastic": ("plastic", "rubber"),
    "leaf": ("leaf", "leaves", "foliage"),
    "bark": ("bark",),
    "paper": ("paper", "cardboard"),
    "plaster": ("plaster", "paint", "stucco", "wall"),
    "ground": ("ground", "soil", "gravel", "sand", "grass", "mud", "snow", "forest", "pebble"),
    "leather": ("leather",),
}
assert set(_ROLE_WORDS) | {"any"} == set(get_args(Role))


@dataclass(frozen=True)
class TextureSet:
    """Images that belong together.

    Attributes:
        asset: its id, place, licence, and the hash of its files' hashes in order of their kinds.
        maps: (kind, path relative to the folder) of each image.
        directx: whether the normal map's y points down.
        role: what it is made of by its name; ``any`` where that does not say.
    """

    asset: Asset
    maps: tuple[tuple[str, str], ...]
    directx: bool
    role: Role


def find_texture_sets(
    folder: Path, catalogue: Path | None = None, allow_unlicensed: Collection[str] | Literal["all"] = ()
) -> list[TextureSet]:
    """List the sets of a folder in order of their ids.

    A catalogue's ``path`` names a set by its id, its folder, or its albedo image.

    Raises:
        TronError: no folder, no set, a set without albedo or licence, an image that is damaged or too large.
    """
    if not folder.is_dir():
        raise TronError("folder of textures not found", folder)
    groups = _groups(folder)
    if not groups:
        raise TronError("no texture sets in the folder", folder, "name images as in wood_albedo.png")
    entries = read_catalogue(
        catalogue if catalogue is not None else folder / CATALOGUE_NAME, catalogue is not None
    )
    sets, unlicensed = [], {}
    for name, (maps, directx) in sorted(groups.items()):
        if "albedo" not in maps:
            raise TronError(f"texture set '{name}' has no albedo", folder, f"add {name}_albedo.png")
        for kind, path in maps.items():
            _read(folder / path, display=kind == "albedo")
        keys = (name, str(Path(maps["albedo"]).parent.as_posix()), maps["albedo"])
        entry = next((entries[key] for key in keys if key in entries), None)
        if entry is None or not entry.licence:
            unlicensed[name] = maps["albedo"]
        contents = tuple(
            Content(
                path=maps[kind], kind=texture_kind(folder / maps[kind]), sha256=sha256(folder / maps[kind])
            )
            for kind in sorted(maps)
        )
        digest = hashlib.sha256("".join(each.sha256 for each in contents).encode())
        asset = Asset(
            id=name,
            path=maps["albedo"],
            sha256=digest.hexdigest(),
            licence=entry.licence if entry else None,
            author=entry.author if entry else None,
            source=entry.source if entry else None,
            contents=contents,
        )
        sets.append(TextureSet(asset, tuple(sorted(maps.items())), directx, _role(name)))
    require_licences("texture set", folder, unlicensed, allow_unlicensed)
    return sets


def opened(
    spec: PhotographedSpec, folder: Path | None, sets: Sequence[TextureSet], texels_per_unit: float
) -> Photographed:
    """A set with its images, averaged down to about the density that they are looked up at.

    Raises:
        TronError: the set is not there, or is another than the specification names.
    """
    found = next((each for each in sets if each.asset.id == spec.texture_set), None)
    if folder is None or found is None or found.asset.sha256 != spec.sha256:
        what = "is not what it was" if found else "is not there"
        raise TronError(f"texture set '{spec.texture_set}' {what}", folder, "give its folder as textures=...")
    return Photographed(spec, _image(str(folder), found, int(np.ceil(spec.repeat * texels_per_unit))))


@lru_cache(maxsize=SETS_KEPT)
def _image(folder: str, found: TextureSet, width: int) -> np.ndarray:
    """(h, w, 6) as :class:`Photographed` has it, at least ``width`` wide where the set is."""
    maps = {kind: Path(folder) / path for kind, path in found.maps}
    albedo = _reduced(_read(maps["albedo"], display=True), width)
    shape = albedo.shape[:2]

    def read(kind: str) -> np.ndarray | None:
        return _resized(_reduced(_read(maps[kind]), width), shape) if kind in maps else None

    packed, rough, metal = read("packed"), read("roughness"), read("metallic")
    plain = np.ones(shape, np.float32)
    roughness = rough[..., 0] if rough is not None else PLAIN_ROUGHNESS * plain
    metallic = metal[..., 0] if metal is not None else 0.0 * plain
    if packed is not None:
        roughness = packed[..., 1] if rough is None else roughness
        metallic = packed[..., 2] if metal is None else metallic
    height, normal, relief = 0.0 * plain, read("normal"), read("height")
    if normal is not None:
        vectors = 2.0 * normal - 1.0
        vectors[..., 1] *= -1.0 if found.directx else 1.0
        height = height_from_normals(vectors)
    elif relief is not None:
        height = RELIEF * (relief[..., 0] - 0.5)
    image = np.dstack([np.clip(albedo, 0, 1), np.clip(roughness, 0.05, 1), np.clip(metallic, 0, 1), height])
    return np.ascontiguousarray(image, np.float32)


def _groups(folder: Path) -> dict[str, tuple[dict[str, str], bool]]:
    """Set -> its kinds' paths, and whether its normal map is DirectX's; OpenGL's is taken where both are."""
    prefixes: dict[tuple[str, str], dict[str, str]] = {}
    directx: dict[tuple[str, str], bool] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() not in SUFFIXES:
            continue
        words = re.split(r"[_\-. ]+", path.stem)
        low = [word.lower() for word in words]
        last = next((i for i in reversed(range(len(low))) if not _SIDE_WORDS.fullmatch(low[i])), None)
        if last is None:
            continue
        kind = _KINDS.get(low[last])
        if kind is None:
            continue
        first = last - 1 if last and low[last - 1] + low[last] in _KINDS else last
        name = "_".join(word for word in words[:first] if not _SIDE_WORDS.fullmatch(word.lower()))
        relative = path.relative_to(folder)
        key = (relative.parent.as_posix(), name)
        down = kind == "normal" and bool(_DIRECTX & set(low[last:]))
        if kind == "normal" and down and kind in prefixes.get(key, {}):
            continue
        prefixes.setdefault(key, {})[kind] = relative.as_posix()
        if kind == "normal":
            directx[key] = down
    named: dict[str, tuple[dict[str, str], bool]] = {}
    for (parent, name), maps in prefixes.items():
        short = name or Path(parent).name or folder.resolve().name
        unique = short if short not in named else f"{parent}/{name}"
        named[unique] = maps, directx.get((parent, name), False)
    return named


def _role(name: str) -> Role:
    for role, words in _ROLE_WORDS.items():
        if any(word in name.lower() for word in words):
            return role
    return "any"


def _read(path: Path, display: bool = False) -> np.ndarray:
    """(h, w, 3) float32; ``display`` colours become linear, EXR is linear already.

    Raises:
        TronError: the image is damaged, too large, or not finite.
    """
    pixels = read_image(path, color=display)
    if not np.isfinite(pixels).all():
        raise TronError("texture has values that are not finite", path)
    linear = not display or path.suffix.lower() == ".exr"
    return pixels if linear else np.asarray(srgb_to_linear(pixels), np.float32)


def _reduced(image: np.ndarray, width: int) -> np.ndarray:
    """The image averaged by whole blocks, no narrower than ``width``."""
    block = max(image.shape[1] // max(width, 1), 1)
    h, w = image.shape[0] // block, image.shape[1] // block
    if not h:
        return image
    return image[: h * block, : w * block].reshape(h, block, w, block, -1).mean(axis=(1, 3))


def _resized(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The nearest pixels of an image of another size than the albedo's."""
    rows = (np.arange(shape[0]) * image.shape[0]) // shape[0]
    columns = (np.arange(shape[1]) * image.shape[1]) // shape[1]
    return image[rows][:, columns]
