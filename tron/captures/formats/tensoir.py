"""TensoIR's synthetic scenes: photos under known lights with true albedo and normals.

A view is a folder ``train_000`` or ``test_000`` with ``metadata.json`` (Blender's camera), ``rgba.png`` or
``rgba_{light}.png`` (straight alpha, display values), ``albedo.png`` (linear base color behind a curve of
1/2.2, not sRGB's) and ``normal.png`` (world, (n + 1) / 2). Facts of github.com/Haian-Jin/TensoIR.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tron.cameras import opengl_to_opencv, rigid_pose
from tron.captures.photos.image_folder import relative_parts
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.settings import TRAIN_LIGHT, TensoirSettings
from tron.errors import TronError
from tron.io.transforms_json import read_json
from tron.lenses import Lens, opencv_lens

_CURVE = 2.2
_FOLDER = re.compile(r"(train|test)_\d+")


def is_tensoir(path: Path) -> bool:
    """Whether a folder looks like one of TensoIR's scenes."""
    return path.is_dir() and any((each / "metadata.json").is_file() for each in _view_folders(path))


def read_tensoir(path: Path, settings: TensoirSettings) -> PosedPhotos:
    """Read a scene; its world is Blender's, z up.

    Args:
        path: the scene's folder, such as ``lego``.
        settings: which photos to take.

    Raises:
        TronError: no view folders, no view with a photo under this light, unreadable metadata.
    """
    light = settings.tensoir_light
    relative_parts(light)
    folders = _view_folders(path)
    if not folders:
        raise TronError("no folders train_000, test_000, ...", path)
    photos = [_photo(folder, light) for folder in folders]
    if all(photo.path is None for photo in photos):
        raise TronError(f"no view has a photo under the light {light!r}", path)
    return PosedPhotos(path, photos, names=[folder.name for folder in folders])


def _view_folders(path: Path) -> list[Path]:
    return sorted(each for each in path.iterdir() if _FOLDER.fullmatch(each.name) and each.is_dir())


def _photo(folder: Path, light: str) -> PosedPhoto:
    candidates = [folder / f"rgba_{light}.png"]
    if light == TRAIN_LIGHT:
        candidates.append(folder / "rgba.png")
    image = next((each for each in candidates if each.is_file()), None)
    decoders = {"base_color": ("albedo.png", decode_albedo), "normal": ("normal.png", decode_normal)}
    maps = {
        field: (folder / name, decode)
        for field, (name, decode) in decoders.items()
        if (folder / name).is_file()
    }
    split = "train" if folder.name.startswith("train") else "test"
    pose, lens, refused = None, None, None
    try:
        pose, lens = _camera(folder / "metadata.json")
    except TronError as error:
        refused = error.what
    return PosedPhoto(folder.name, image, pose, lens, split, maps, refused)


def _camera(path: Path) -> tuple[np.ndarray, Lens]:
    meta = read_json(path)
    try:
        numbers = [float(each) for each in str(meta["cam_transform_mat"]).split(",")]
        width, height, angle = float(meta["imw"]), float(meta["imh"]), float(meta["cam_angle_x"])
        matrix = np.array(numbers).reshape(4, 4)
    except (KeyError, TypeError, ValueError) as error:
        raise TronError(f"metadata.json has no readable camera: {error}") from error
    if not 0 < angle < np.pi:
        raise TronError(f"cam_angle_x is {angle:g}, not between 0 and pi")
    focal = 0.5 * width / np.tan(0.5 * angle)
    lens = opencv_lens(width, height, (focal, focal), (width / 2, height / 2))
    return opengl_to_opencv(rigid_pose(matrix)), lens


def decode_albedo(stored: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Linear base color (H, W, 3) of stored values; zero outside of the object."""
    return np.where(alpha[..., None] > 0, stored, 0) ** _CURVE


def decode_normal(stored: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Unit world normals (H, W, 3) of stored values; zero outside of the object and where none is stored."""
    normal = 2 * stored - 1
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    known = (length > 0.5) & (alpha[..., None] > 0.5)
    return np.where(known, normal / np.maximum(length, 1e-6), 0).astype(np.float32)
