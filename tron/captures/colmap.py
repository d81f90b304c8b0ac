"""COLMAP's sparse models, binary or text, through pycolmap."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tron.captures.colmap_files import require_whole
from tron.captures.distortion import Lens
from tron.captures.image_folder import ImageFolder, photos_in, view_names
from tron.captures.posed_photos import PosedPhoto, PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.errors import TronError

if TYPE_CHECKING:
    import pycolmap

_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", ".")
_MAX_ERROR = 2.0
_MIN_TRACK = 3


def model_folder(path: Path) -> Path | None:
    """Folder of a capture's sparse model, ``sparse/0`` or its like or the capture's own, if there is any."""
    for name in _FOLDERS:
        folder = path / name
        if any((folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    return None


def read_colmap(path: Path, settings: PhotoSettings) -> PosedPhotos:
    """Read a capture posed by COLMAP; its world is COLMAP's.

    Args:
        path: folder with a model (see :func:`model_folder`) and ``images`` or a reduced copy, ``images_4``.
            For a folder that is ``sparse/0`` itself the images lie beside ``sparse``.
        settings: ``images`` as in :class:`ImageFolder`.

    Raises:
        TronError: no model, or one that pycolmap cannot read.
    """
    folder = model_folder(path)
    if folder is None:
        raise TronError("no COLMAP model", path, "sparse/0 should hold cameras, images and points3D")
    model = read_model(folder)
    root = path
    if folder.resolve() == path.resolve():
        root = path.parent.parent if path.parent.name == "sparse" else path.parent
    found = ImageFolder(root, settings.images or ("." if _beside(root, model) else None))
    prefix = "" if found.images is not None else "images/"
    photos = []
    for name, camera_to_world, lens in posed_by(model):
        photos.append(PosedPhoto(name, found.find(prefix + name, folder), camera_to_world, lens))
    points, colors = points_of(model)
    used = {photo.path for photo in photos}
    folders = {each.parent for each in used if each is not None}
    unposed = [each.name for parent in sorted(folders) for each in photos_in(parent) if each not in used]
    skipped = dict.fromkeys(view_names(unposed), "not posed by COLMAP") if unposed else {}
    return PosedPhotos(path, photos, points, colors, skipped=skipped)


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a sparse model; TronError if pycolmap cannot or if it holds no posed image."""
    import pycolmap

    require_whole(folder)
    pycolmap.logging.minloglevel = 3  # what is wrong with a file is ours to report
    try:
        model = pycolmap.Reconstruction(folder)
    except Exception as error:  # damaged files raise ValueError, IndexError, MemoryError, RuntimeError
        raise TronError(f"not a readable COLMAP model: {error}", folder) from error
    if not any(image.has_pose for image in model.images.values()):
        raise TronError("COLMAP model holds no posed image", folder)
    return model


def posed_by(model: pycolmap.Reconstruction) -> list[tuple[str, np.ndarray, Lens]]:
    """Name, (4, 4) OpenCV camera-to-world and lens of every posed image, in the order of names.

    A lens that pycolmap knows and that has no pinhole view is refused when a photo of it is used.
    """
    posed = []
    for image in sorted(model.images.values(), key=lambda each: each.name):
        if not image.has_pose:
            continue
        camera_to_world = np.eye(4)
        camera_to_world[:3] = image.cam_from_world().inverse().matrix()
        posed.append((image.name, camera_to_world, _lens(model.cameras[image.camera_id])))
    return posed


def points_of(model: pycolmap.Reconstruction) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Points (N, 3) and display colours (N, 3) that several photos agree on; None if there are none.

    Kept are points that at least three photos saw and that project within two pixels of where they were seen
    on average; if that leaves less than a tenth, all finite ones are.
    """
    points = list(model.points3D.values())
    if not points:
        return None, None
    xyz = np.array([point.xyz for point in points])
    colors = np.array([point.color for point in points], np.float64) / 255
    errors = np.array([point.error for point in points])
    tracks = np.array([point.track.length() for point in points])
    finite = np.isfinite(xyz).all(1)
    good = finite & (tracks >= _MIN_TRACK) & ~(errors > _MAX_ERROR)
    kept = good if good.sum() >= 0.1 * len(good) else finite
    return (xyz[kept], colors[kept]) if kept.any() else (None, None)


def _lens(camera: pycolmap.Camera) -> Lens:
    return Lens(camera.model.name, camera.width, camera.height, tuple(camera.params))


def _beside(root: Path, model: pycolmap.Reconstruction) -> bool:
    """Whether the images lie in the capture's folder itself, and not in ``images`` or a reduced copy."""
    if any(each.is_dir() for each in root.glob("images*")):
        return False
    return any((root / image.name).is_file() for image in list(model.images.values())[:10])
