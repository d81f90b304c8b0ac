"""OpenSfM's ``reconstruction.json``, which OpenDroneMap writes as ``opensfm/reconstruction.json``.

The file is a list of reconstructions. One has cameras by name, with focal and c_x, c_y in units of the larger
side from the middle of the picture; shots by the photo's name, whose rotation is an axis times an angle and
whose rotation and translation take the world to OpenCV's camera axes; and coloured points.
(https://opensfm.org/docs/dataset.html, /geometry.html)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tron.captures.photos.image_folder import ImageFolder
from tron.captures.photos.panoramas import Panorama
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.errors import TronError, located
from tron.io.transforms_json import number, read_list
from tron.lenses import Lens, opencv_lens

_SPHERICAL = ("spherical", "equirectangular")
_NAMES = ("reconstruction.json", "opensfm/reconstruction.json")


def reconstruction_file(path: Path) -> Path | None:
    """OpenSfM's file of a project of OpenSfM or ODM; None where a folder is none."""
    return next((path / name for name in _NAMES if (path / name).is_file()), None)


def read_opensfm(path: Path, settings: PhotoSettings) -> PosedPhotos:
    """Read the largest reconstruction.

    Args:
        path: the project's folder, which holds ``images``.
        settings: ``images``, where they are instead.

    Raises:
        TronError: no such file, or one of another shape.
    """
    file = reconstruction_file(path)
    if file is None:
        raise TronError("no reconstruction.json", path)
    with located(file):
        parts = [each for each in read_list(file) if isinstance(each, dict) and _objects(each, "shots")]
        if not parts:
            raise TronError("no reconstruction with shots", mend="is it OpenSfM's?")
        largest = max(parts, key=lambda each: len(each["shots"]))
        cameras = _objects(largest, "cameras")
        images = ImageFolder(path, settings.images)
        photos = [
            _photo(name, shot, cameras, images, file) for name, shot in sorted(largest["shots"].items())
        ]
        points = [each for each in _objects(largest, "points").values() if isinstance(each, dict)]
        places = _vectors(points, "coordinates")
        colors = _vectors(points, "color")
    whole = places is not None and colors is not None and len(places) == len(colors)
    return PosedPhotos(path, photos, places, colors / 255 if whole and colors is not None else None)


def _objects(values: Mapping[str, Any], key: str) -> dict[str, Any]:
    found = values.get(key)
    return found if isinstance(found, dict) else {}


def _photo(
    name: str, shot: object, cameras: Mapping[str, Any], images: ImageFolder, file: Path
) -> PosedPhoto:
    image = images.find(name if images.images else f"images/{name}", file)
    if not isinstance(shot, dict):
        return PosedPhoto(name, image, None, None, refused="the shot is no object")
    camera = cameras.get(str(shot.get("camera")))
    rotation, translation = (_vector(shot.get(key)) for key in ("rotation", "translation"))
    if not isinstance(camera, dict) or rotation is None or translation is None:
        return PosedPhoto(name, image, None, None, refused="the shot lacks a camera, rotation or translation")
    to_camera = np.eye(4)
    to_camera[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    to_camera[:3, 3] = translation
    return PosedPhoto(name, image, np.linalg.inv(to_camera), _lens_maker(camera))


def _lens_maker(camera: Mapping[str, Any]) -> Callable[[int, int], Lens | Panorama]:
    def lens(width: int, height: int) -> Lens | Panorama:
        w, h = number(camera, "width", width), number(camera, "height", height)
        side, kind = max(w, h), camera.get("projection_type", "perspective")
        if kind in _SPHERICAL:
            return Panorama(w, h)
        k1, k2, k3 = (number(camera, key, 0.0) for key in ("k1", "k2", "k3"))
        if kind == "perspective":
            focal = number(camera, "focal", 0.0)
            return opencv_lens(w, h, (focal * side, focal * side), (w / 2, h / 2), radial=(k1, k2, 0.0))
        if kind == "brown":
            fx, fy, cx, cy = (number(camera, key, 0.0) for key in ("focal_x", "focal_y", "c_x", "c_y"))
            return opencv_lens(
                w, h, (fx * side, fy * side), (w / 2 + cx * side, h / 2 + cy * side),
                radial=(k1, k2, k3), tangential=(number(camera, "p1", 0.0), number(camera, "p2", 0.0)),
            )  # fmt: skip
        raise TronError(f"projection {kind!r} is not supported")

    return lens


def _vector(values: object) -> np.ndarray | None:
    try:
        found = np.array(values, np.float64)
    except (TypeError, ValueError):
        return None
    return found if found.shape == (3,) and np.isfinite(found).all() else None


def _vectors(points: list[dict[str, Any]], key: str) -> np.ndarray | None:
    found = [_vector(each.get(key)) for each in points]
    whole = [each for each in found if each is not None]
    return np.stack(whole) if whole and len(whole) == len(found) else None
