"""One door for every kind of capture."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from tron.captures.assembly import assemble
from tron.captures.capture import Capture
from tron.captures.not_a_capture import refusal
from tron.captures.settings import Format, LoadSettings
from tron.errors import TronError


def load_capture(path: str | os.PathLike[str], settings: LoadSettings | None = None) -> Capture:
    """Load a capture; photos are decoded when they are looked at.

    Formats, in the order in which ``auto`` looks for them:

    - ``tron``: our own path-traced views, a ``transforms.json`` with the key ``tron``;
    - ``transforms``: ``transforms.json`` or ``transforms_train.json`` (NeRF, instant-ngp, nerfstudio, DL3DV);
    - ``colmap``: ``sparse/0``, binary or text;
    - ``tensoir``: folders ``train_000``, ... with ``metadata.json``;
    - ``photos``: no poses, but photos in ``images`` or the folder itself; structure from motion poses them.

    What the files name and cannot be used is in ``Capture.skipped`` and is logged in one line.

    Args:
        path: the capture's folder, or its transforms file.
        settings: see :class:`LoadSettings`.

    Raises:
        TronError: nothing there, no poses and no photos, poses without photos, fewer than two usable views,
            all views held out, files that cannot be read.
    """
    path = Path(path)
    settings = settings or LoadSettings()
    if not path.exists():
        raise TronError("capture not found", path)
    if path.is_file() and path.suffix.lower() != ".json":
        raise refusal(path)
    kind = _detected(path) if settings.format == "auto" else settings.format
    if kind == "tron":
        return _path_traced(path, settings)
    if kind == "transforms":
        from tron.captures.transforms import read_transforms

        return assemble(read_transforms(path, settings.images), settings)
    if not path.is_dir():
        raise TronError(f"a capture of format {kind} is a folder", path)
    if kind == "colmap":
        from tron.captures.colmap import read_colmap

        return assemble(read_colmap(path, settings.images), settings)
    if kind == "tensoir":
        from tron.captures.tensoir import read_tensoir

        return assemble(read_tensoir(path, settings.light), settings)
    from tron.captures.structure_from_motion import pose_photos

    return assemble(pose_photos(_photo_folder(path, settings.images), settings.posing), settings)


def _path_traced(path: Path, settings: LoadSettings) -> Capture:
    """Our own views, read as they are: their maps hold values that resizing must not mix."""
    from tron.captures.folder import read_capture_folder

    capture = read_capture_folder(path)
    for view in capture.views:
        size = (view.camera.width, view.camera.height)
        if settings.size_of(*size) != size:
            raise TronError("path-traced views cannot be reduced", path, "render them smaller")
    if settings.up is None:
        return capture
    return replace(capture, up=np.array(settings.up, float) / np.linalg.norm(settings.up))


def _detected(path: Path) -> Format:
    from tron.captures.colmap import model_folder
    from tron.captures.image_folder import photos_in
    from tron.captures.tensoir import is_tensoir
    from tron.captures.transforms import read_json

    poses = path / "transforms.json" if path.is_dir() else path
    if poses.is_file():
        return "tron" if "tron" in read_json(poses) else "transforms"
    if (path / "transforms_train.json").is_file():
        return "transforms"
    if model_folder(path):
        return "colmap"
    if is_tensoir(path):
        return "tensoir"
    if photos_in(path / "images") or photos_in(path):
        return "photos"
    raise refusal(path)


def _photo_folder(path: Path, images: str | Path | None) -> Path:
    from tron.captures.image_folder import photos_in

    if images is not None:
        return path / images
    return path / "images" if photos_in(path / "images") else path
