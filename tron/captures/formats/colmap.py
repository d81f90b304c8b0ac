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

import numpy as np

from tron.captures.photos.distortion import Lens, impossible, load_pycolmap
from tron.captures.photos.image_folder import ImageFolder, photos_in, view_names
from tron.captures.photos.panoramas import Panorama
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.errors import TronError

if TYPE_CHECKING:
    import pycolmap


log = logging.getLogger(__name__)

_MAX_ERROR = 2.0
_MIN_TRACK = 3
_CAMERA_BYTES = 24 + 2 * 8  # id, model, width, height and at least two parameters
_POSE_BYTES = 7 * 8
INPUT = "input"
"""Folder of the original photos in 3DGS' layout."""
_DISTORTED = "distorted"
_PARENTS = ("sparse", "colmap/sparse", ".", f"{_DISTORTED}/sparse")
_NAME_FIELD = 9  # of a line of images.txt: id, quaternion, translation, camera id, name
RENAME = "rename the photos before COLMAP poses them"
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
        photos.append(PosedPhoto(name, image, camera_to_world, lens, refused=impossible(lens)))
    points, colors = points_of(model)
    used = {photo.path for photo in photos}
    folders = {each.parent for each in used if each is not None}
    unposed = [each.name for parent in sorted(folders) for each in photos_in(parent) if each not in used]
    skipped = dict.fromkeys(view_names(unposed), "not posed by COLMAP") if unposed else {}
    return PosedPhotos(path, photos, points, colors, skipped=skipped)


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a sparse model; TronError if pycolmap cannot or if it holds no posed image."""
    pycolmap = load_pycolmap()
    require_whole(folder)
    try:
        model = pycolmap.Reconstruction(folder)
    except Exception as error:  # damaged files raise ValueError, IndexError, MemoryError, RuntimeError
        raise TronError(f"not a readable COLMAP model: {error}", folder) from error
    if not any(image.has_pose for image in model.images.values()):
        raise TronError("COLMAP model holds no posed image", folder)
    if is_text(folder):
        for number, name in names_in_text(folder).items():
            model.images[number].name = name
    try:
        _ = [image.name for image in model.images.values()]
    except UnicodeDecodeError as error:
        raise TronError("COLMAP model's image names are not UTF-8", folder, RENAME) from error
    return model


def posed_by(
    model: pycolmap.Reconstruction,
) -> list[tuple[str, np.ndarray, Lens | Callable[[int, int], Panorama]]]:
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


def _lens(camera: pycolmap.Camera) -> Lens | Callable[[int, int], Panorama]:
    if camera.model.name == "EQUIRECTANGULAR":
        return lambda *_: Panorama(camera.width, camera.height)
    return Lens(camera.model.name, camera.width, camera.height, tuple(camera.params))


def _beside(root: Path, model: pycolmap.Reconstruction) -> bool:
    """Whether the images lie in the capture's folder itself, and not in ``images`` or a reduced copy."""
    if any(each.is_dir() for each in root.glob("images*")):
        return False
    return any((root / image.name).is_file() for image in list(model.images.values())[:10])


# pycolmap believes the counts: of a file that was cut short or is not COLMAP's it may read on for hours. The
# layout is that of COLMAP's ``reconstruction_io_binary.cc``; all numbers are little endian.


def require_whole(folder: Path) -> None:
    """Walk through the binary files of a sparse model; those that are absent or text are not looked at.

    Raises:
        TronError: a file ends before its last record.
    """
    for name, walk in _WALKS.items():
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
        try:
            data = path.read_bytes()
            (count,) = struct.unpack_from("<Q", data)
            if count > len(data):  # every record has at least a byte; do not count to 2**64
                raise ValueError(count)
            end = walk(data, count)
        except OSError as error:
            raise TronError(f"cannot read: {error.strerror or error}", path) from error
        except (struct.error, ValueError) as error:
            raise TronError("COLMAP file is cut short or damaged", path) from error
        if end > len(data):
            raise TronError("COLMAP file is cut short or damaged", path)


def _cameras(_data: bytes, count: int) -> int:
    return 8 + count * _CAMERA_BYTES


def _images(data: bytes, count: int) -> int:
    """id, pose, camera id; the name, ended by zero; a count of 2D points and x, y, point id of each."""
    at = 8
    for _ in range(count):
        at = data.index(b"\0", at + 8 + _POSE_BYTES) + 1
        (points,) = struct.unpack_from("<Q", data, at)
        at += 8 + 24 * points
    return at


def _points(data: bytes, count: int) -> int:
    """id, position, colour, error; a count of track elements and image id, index of each."""
    at = 8
    for _ in range(count):
        (track,) = struct.unpack_from("<Q", data, at + 43)
        at += 51 + 8 * track
    return at


def _rigs(data: bytes, count: int) -> int:
    """id, count of sensors; the first one's type and id; of the others also a flag and, if set, a pose."""
    at = 8
    for _ in range(count):
        (sensors,) = struct.unpack_from("<I", data, at + 4)
        at += 8 + (8 if sensors else 0)
        for _ in range(1, sensors):
            at += 9 + (_POSE_BYTES if data[at + 8 : at + 9] != b"\0" else 0)
            if at > len(data):
                return at
    return at


def _frames(data: bytes, count: int) -> int:
    """id, rig id, pose; a count of data and sensor type, sensor id, data id of each."""
    at = 8
    for _ in range(count):
        (data_ids,) = struct.unpack_from("<I", data, at + 8 + _POSE_BYTES)
        at += 12 + _POSE_BYTES + 16 * data_ids
    return at


_WALKS: dict[str, Callable[[bytes, int], int]] = {
    "cameras": _cameras,
    "images": _images,
    "points3D": _points,
    "rigs": _rigs,
    "frames": _frames,
}


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


def names_in_text(model: Path) -> dict[int, str]:
    """Names by image id in ``images.txt``, spaces and all: pycolmap ends them at the first.

    Raises:
        TronError: the file cannot be read, or its lines are not two an image.
    """
    path = model / "images.txt"
    names: dict[int, str] = {}
    try:
        with path.open(encoding="utf-8") as lines:
            for line in lines:
                if not line.strip() or line.lstrip().startswith("#"):
                    continue
                fields = line.strip().split(maxsplit=_NAME_FIELD)
                names[int(fields[0])] = fields[_NAME_FIELD]
                int((next(lines, "").split()[-1:] or ["0"])[0])  # x, y and point id of each; often none
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    except UnicodeDecodeError as error:
        raise TronError("COLMAP model's image names are not UTF-8", path, RENAME) from error
    except (ValueError, IndexError) as error:
        mend = "each image has two lines, the second of its points or empty"
        raise TronError("not a readable COLMAP model", path, mend) from error
    return names


def is_text(model: Path) -> bool:
    """Whether pycolmap reads a model's text files: it does where one of the binary ones is missing."""
    return not all((model / f"{name}.bin").is_file() for name in ("cameras", "images", "points3D"))


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
