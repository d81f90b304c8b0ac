"""``transforms.json`` of NeRF-synthetic, instant-ngp, nerfstudio and DL3DV.

The dialects agree on OpenGL camera-to-world matrices; they differ in what else they say:

- NeRF-synthetic: one file a split, ``camera_angle_x`` alone, names without ``.png``;
- instant-ngp: intrinsics and OpenCV distortion for the file, ``is_fisheye``;
- nerfstudio: the same for the file or each frame, ``camera_model`` (EQUIRECTANGULAR of photos of 360 degrees,
  without a focal length), ``train_filenames`` and so on, ``applied_transform`` and ``applied_scale``, points
  in ``ply_file_path``;
- DL3DV: nerfstudio's, with intrinsics of the full resolution and reduced images.

The capture's world is COLMAP's (:mod:`tron.io.transforms_json`). Points are written in that of the file and
taken along; where there are none, a COLMAP model that lies beside gives its own. ``mask_path`` and
``depth_file_path`` are nerfstudio's.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from tron.cameras import opengl_to_opencv, rigid_pose
from tron.captures.folder import read_points
from tron.captures.formats.colmap import model_folder
from tron.captures.formats.not_a_capture import require_poses_of_photos
from tron.captures.photos.image_folder import ImageFolder, relative_parts
from tron.captures.photos.panoramas import Panorama
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.errors import TronError
from tron.io.transforms_json import (
    EQUIRECTANGULAR,
    described,
    frames_of,
    intrinsics_of,
    number,
    read_json,
    to_original,
)
from tron.lenses import Lens, opencv_lens

log = logging.getLogger(__name__)

_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = "OPENCV_FISHEYE"
_SAME_PLACE = 0.01
_SPLITS = ("train", "val", "test")

Split = Literal["train", "test"]


def has_transforms(path: Path) -> bool:
    """Whether a path is, or a folder holds, a file of poses that :func:`read_transforms` reads."""
    if not path.is_dir():
        return path.suffix.lower() == ".json"
    return any((path / f"transforms{end}.json").is_file() for end in ("", "_train"))


def read_transforms(path: Path, settings: PhotoSettings) -> PosedPhotos:
    """Read the poses of a capture.

    Args:
        path: a ``.json`` file, or a folder with ``transforms.json`` or ``transforms_train.json`` (and
            ``transforms_test.json``, which is held out; ``transforms_val.json`` is left alone).
        settings: ``images`` as in :class:`ImageFolder`.

    Raises:
        TronError: unreadable JSON, JSON of another shape, an image name that leads out of the folder.
    """
    files = _files(path)
    root = path if path.is_dir() else path.parent
    folder = ImageFolder(root, settings.images)
    photos: list[PosedPhoto] = []
    points = colors = None
    transform = np.eye(4)
    for file, split in files:
        meta = read_json(file)
        transform = to_original(meta, file)
        require_poses_of_photos(meta, file)
        listed = _listed_splits(meta, file)
        for index, frame in enumerate(frames_of(meta, file)):
            photo = _photo(frame, meta, f"{file}, frame {index}", folder, transform)
            photos.append(_assigned(photo, split, listed))
        if points is None and isinstance(meta.get("ply_file_path"), str):
            points, colors = _points(root, meta["ply_file_path"], transform)
    if points is None and "applied_transform" in meta:
        points, colors = _colmap_points(root, photos)
    return PosedPhotos(path, photos, points, colors, transform)


def _files(path: Path) -> list[tuple[Path, Split | None]]:
    if path.is_file():
        return [(path, None)]
    if (path / "transforms.json").is_file():
        return [(path / "transforms.json", None)]
    train, test = path / "transforms_train.json", path / "transforms_test.json"
    if not train.is_file():
        raise TronError("no transforms.json or transforms_train.json", path)
    return [(train, "train"), (test, "test")] if test.is_file() else [(train, None)]


def _photo(
    frame: object, meta: Mapping[str, Any], where: str, folder: ImageFolder, transform: np.ndarray
) -> PosedPhoto:
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise TronError("frame has no file_path", where)
    name, matrix = frame["file_path"], frame.get("transform_matrix")
    image = folder.find(name, where)
    camera_to_world, refused = None, None
    try:
        camera_to_world = transform @ opengl_to_opencv(rigid_pose(matrix))
    except TronError as error:
        refused = error.what
    mask, depth = (_beside(frame, key, where, folder.root) for key in ("mask_path", "depth_file_path"))
    return PosedPhoto(
        name,
        image,
        camera_to_world,
        _lens_maker(described(meta, frame)),
        mask=mask,
        depth=depth,
        depth_scale=float(np.cbrt(np.linalg.det(transform[:3, :3]))),
        refused=refused,
    )


def _beside(frame: Mapping[str, Any], key: str, where: str, root: Path) -> Path | None:
    """File of one more image of the frame's pixels, in the capture's folder; None where none is named."""
    name = frame.get(key)
    if name is None:
        return None
    if not isinstance(name, str):
        raise TronError(f"{key} is {name!r}, not a name", where)
    try:
        return root.joinpath(*relative_parts(name))
    except TronError as error:
        raise TronError(error.what.replace("image name", key), where, error.mend) from error


def _lens_maker(data: Mapping[str, Any]) -> Callable[[int, int], Lens | Panorama]:
    def lens(width: int, height: int) -> Lens | Panorama:
        if data.get("camera_model") == EQUIRECTANGULAR:
            return Panorama(number(data, "w", width), number(data, "h", height))
        w, h, focal, center = intrinsics_of(data, width, height)
        k1, k2, k3, k4 = (number(data, key, 0.0) for key in ("k1", "k2", "k3", "k4"))
        tangential = (number(data, "p1", 0.0), number(data, "p2", 0.0))
        model = data.get("camera_model") or (_FISHEYE if data.get("is_fisheye") else "OPENCV")
        if model == _FISHEYE:
            return Lens(_FISHEYE, w, h, (*focal, *center, k1, k2, k3, k4))
        if model not in _PERSPECTIVE:
            raise TronError(f"camera model {model!r} is not supported")
        if k4:
            raise TronError("a fourth radial coefficient k4 is read in different ways: calibrate without it")
        return opencv_lens(w, h, focal, center, radial=(k1, k2, k3), tangential=tangential)

    return lens


def _listed_splits(meta: Mapping[str, Any], file: Path) -> dict[tuple[str, ...], str]:
    """Split of each image that nerfstudio's lists name; empty where there are none."""
    listed: dict[tuple[str, ...], str] = {}
    for split in _SPLITS:
        names = meta.get(f"{split}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise TronError(f"{split}_filenames is not a list of names", file)
        listed |= {relative_parts(name): split for name in names}
    if "test" not in listed.values():  # a file with train and val alone means val to be held out
        listed = {name: "test" if split == "val" else split for name, split in listed.items()}
    return listed


def _assigned(photo: PosedPhoto, split: Split | None, listed: Mapping[tuple[str, ...], str]) -> PosedPhoto:
    if not listed:
        return replace(photo, split=split)
    name = listed.get(relative_parts(photo.name))
    if name is None or name == "val":
        reason = "a validation view" if name else "in none of the file's lists of train and test views"
        return replace(photo, refused=photo.refused or reason)
    return replace(photo, split=name)


def _points(root: Path, name: str, transform: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Finite points (N, 3) in the capture's world and colours (N, 3) of a PLY in the file's world."""
    points, colors = read_points(root.joinpath(*relative_parts(name)))
    finite = np.isfinite(points).all(1)
    points = points[finite] @ transform[:3, :3].T + transform[:3, 3]
    return points, None if colors is None else colors[finite]


def _colmap_points(root: Path, photos: Sequence[PosedPhoto]) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Points and colours of a COLMAP model beside the file, if its cameras stand where the file's do."""
    from tron.io.colmap import points_of, posed_by, read_model

    folder = model_folder(root)
    if folder is None:
        return None, None
    try:
        model = read_model(folder)
    except TronError as error:
        log.warning("%s; the capture has no points", error)
        return None, None
    theirs = {PurePosixPath(name).stem: matrix[:3, 3] for name, matrix, _ in posed_by(model)}
    ours = {PurePosixPath(photo.name).stem: photo.camera_to_world for photo in photos if not photo.refused}
    pairs = [(np.asarray(ours[stem])[:3, 3], theirs[stem]) for stem in sorted(ours.keys() & theirs.keys())]
    if len(pairs) < 2:
        return None, None
    mine, other = (np.array(each) for each in zip(*pairs))
    apart = np.median(np.linalg.norm(mine - other, axis=1))
    extent = np.median(np.linalg.norm(other - np.median(other, axis=0), axis=1))
    if not apart < _SAME_PLACE * extent:
        log.warning("%s: its cameras stand elsewhere than those of transforms.json; points not used", folder)
        return None, None
    return points_of(model)
