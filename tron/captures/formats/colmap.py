"""COLMAP's sparse models, binary or text, through pycolmap: which is taken, and where its photos lie.

COLMAP writes a model for each group of photos that it could not connect, ``sparse/0``, ``sparse/1``; their
numbers say nothing of their size. 3DGS' ``convert.py`` keeps the original photos in ``input``, their model in
``distorted/sparse``, photos without distortion in ``images`` and their model in ``sparse``.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from tron.captures.photos.image_folder import ImageFolder, photos_in, view_names
from tron.captures.photos.panoramas import Panorama
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.errors import TronError
from tron.io.colmap import names_in_text, points_of, posed_by, read_model
from tron.lenses import Lens, impossible

if TYPE_CHECKING:
    import pycolmap


log = logging.getLogger(__name__)

INPUT = "input"
"""Folder of the original photos in 3DGS' layout."""
_DISTORTED = "distorted"
_PARENTS = ("sparse", "colmap/sparse", ".", f"{_DISTORTED}/sparse")
_IMAGE_BYTES = 73  # of the shortest image in images.bin


def read_colmap(path: Path, settings: PhotoSettings) -> PosedPhotos:
    """Read a capture posed by COLMAP; its world is COLMAP's.

    Of several models the one with most photos is taken; a line says which, and how many the others have.

    Args:
        path: folder with a model (see :func:`model_sizes`) and ``images``, a reduced copy, ``images_4``, or
            3DGS' ``input``. For a folder that is ``sparse/0`` itself the images lie beside ``sparse``.
        settings: ``images`` as in :class:`ImageFolder`.

    Raises:
        TronError: no model, or one that pycolmap cannot read.
    """
    sizes = model_sizes(path)
    if not sizes:
        raise TronError("no COLMAP model", path, "sparse/0 should hold cameras, images and points3D")
    folder = max(sizes, key=sizes.__getitem__)
    model = read_model(folder)
    if len(sizes) > 1:
        others = ", ".join(f"{each} has {count}" for each, count in sizes.items() if each != folder)
        log.info("%s is taken, the COLMAP model with most photos, %d; %s", folder, sizes[folder], others)
    root = photo_root(path, folder)
    beside = "." if _beside(root, model) else None
    found = ImageFolder(root, settings.images or photo_folder(root, folder) or beside)
    prefix = "" if found.images is not None else "images/"
    photos = []
    for name, camera_to_world, lens in posed_by(model):
        image = found.find(prefix + name, folder)
        photos.append(PosedPhoto(name, image, camera_to_world, lens_of(lens), refused=impossible(lens)))
    points, colors = points_of(model)
    used = {photo.path for photo in photos}
    folders = {each.parent for each in used if each is not None}
    unposed = [each.name for parent in sorted(folders) for each in photos_in(parent) if each not in used]
    skipped = dict.fromkeys(view_names(unposed), "not posed by COLMAP") if unposed else {}
    return PosedPhotos(path, photos, points, colors, skipped=skipped)


def lens_of(found: Lens | tuple[int, int]) -> Lens | Callable[[int, int], Panorama]:
    """What :func:`tron.io.colmap.posed_by` gives as photos have it."""
    return found if isinstance(found, Lens) else lambda *_: Panorama(*found)


def _beside(root: Path, model: pycolmap.Reconstruction) -> bool:
    """Whether the images lie in the capture's folder itself, and not in ``images`` or a reduced copy."""
    if any(each.is_dir() for each in root.glob("images*")):
        return False
    return any((root / image.name).is_file() for image in list(model.images.values())[:10])


def model_folder(path: Path) -> Path | None:
    """Folder of the model with most photos in a capture's folder, or None if there is no model."""
    sizes = model_sizes(path)
    return max(sizes, key=sizes.__getitem__) if sizes else None


def model_sizes(path: Path) -> dict[Path, int]:
    """Number of posed photos by the folder of each model, those preferred among equals first.

    Sought are ``sparse``, ``colmap/sparse``, the folder itself and 3DGS' ``distorted/sparse``, and numbered
    folders in each. A model of distorted photos counts where these are there or no other model is. A damaged
    one has none.
    """
    found = [
        each
        for parent in _PARENTS
        for each in (*_numbered(path / parent), path / parent)
        if any((each / f"images{suffix}").is_file() for suffix in (".bin", ".txt"))
    ]
    roots = {each: photo_root(path, each) for each in found}
    usable = [each for each, root in roots.items() if (root / INPUT).is_dir() or not _of_input(root, each)]
    return {each: _size(each) for each in usable or found}


def photo_root(path: Path, model: Path) -> Path:
    """Folder in which the photos of a model are sought: the one given as the capture, or that which holds it.

    Args:
        path: what was given as the capture: perhaps ``sparse`` or ``sparse/0`` alone.
        model: folder of the model, ``path`` or below it.
    """
    if (path / INPUT).is_dir() or any(each.is_dir() for each in path.glob("images*")):
        return path
    root = model.resolve()
    root = root if root.name == "sparse" else root.parent
    root = root.parent if root.name == "sparse" else root
    return root.parent if root.name in (_DISTORTED, "colmap") else root


def photo_folder(root: Path, model: Path) -> str | None:
    """Folder of a model's photos where that is 3DGS' ``input``; None: the usual one."""
    usual = any(each.is_dir() for each in root.glob("images*"))
    return INPUT if (root / INPUT).is_dir() and (_of_input(root, model) or not usual) else None


def _size(model: Path) -> int:
    path = model / "images.bin"
    try:
        if not path.is_file():
            return len(names_in_text(model))
        with path.open("rb") as file:
            (count,) = struct.unpack("<Q", file.read(8))
        # A damaged file may claim anything.
        return count if count * _IMAGE_BYTES <= path.stat().st_size else 0
    except (OSError, struct.error, TronError):
        return 0  # reading it says what is wrong, where there is no other


def _numbered(folder: Path) -> list[Path]:
    numbered = [each for each in folder.glob("*") if each.name.isdecimal()]
    return sorted(numbered, key=lambda each: int(each.name))


def _of_input(root: Path, model: Path) -> bool:
    return model.resolve().is_relative_to((root / _DISTORTED).resolve())
