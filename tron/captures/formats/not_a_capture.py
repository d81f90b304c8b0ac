"""Files that people give in place of a capture, and where each of them belongs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from shlex import quote
from typing import Any

from tron.captures.photos.photo_files import SUFFIXES
from tron.errors import TronError
from tron.gaussians.formats.registry import PACKED
from tron.io.recognised import VIDEOS, recognised

_PHOTO = ("one photo", "give the folder of all photos of the scene")
_ENVIRONMENT = ("an environment map, not a capture", "tron-relight environment=FILE takes it")
_MODEL = (
    "a mesh, not photos",
    "tron-datagen renders meshes (assets=FOLDER)",
)
_KINDS: dict[str, tuple[str, str]] = {
    **dict.fromkeys(SUFFIXES, _PHOTO),
    ".ply": (
        "a PLY of splats or points, not photos",
        "tron-reconstruct capture=FILE.ply and tron-relight scene=FILE.ply take splats",
    ),
    **dict.fromkeys((".hdr", ".exr"), _ENVIRONMENT),
    **dict.fromkeys((".obj", ".glb", ".gltf", ".fbx", ".stl"), _MODEL),
    **dict.fromkeys(
        (".bin", ".db"), ("a part of a COLMAP model", "give the folder that holds sparse/0 and the photos")
    ),
}
_RAW = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".srf", ".sr2", ".raf", ".orf", ".rw2"),
    *(".pef", ".srw", ".x3f", ".3fr", ".iiq", ".erf", ".gpr", ".rwl"),
)
_UNREAD = (".jxl", ".jp2", ".j2k", ".psd", ".gif", ".ppm", ".tga")
_CAMERA_PATH = "camera_path"


def refusal(path: Path, captures: str, holds_capture: Callable[[Path], bool]) -> TronError:
    """Error for a file other than ``.json``, or a folder without poses and photos: what there is instead.

    Args:
        path: the file or folder.
        captures: what there might be, for the line's end.
        holds_capture: whether a folder is a capture: one that lies in the given one is named.
    """
    if not path.is_dir():
        kind = _unread(path) or _kind(path)
        if kind is None:
            return TronError("a capture is a folder or a transforms.json", path)
        return TronError(f"a capture is a folder or a transforms.json, this is {kind[0]}", path, kind[1])
    kind = _kind(path)
    if kind is not None:
        return TronError(f"no capture that is read, this is {kind[0]}", path, kind[1])
    for folder in (path, path / "images", path / "input"):
        for file in _files(folder):
            if (mend := _unread(file)) is not None:
                return TronError(mend[0], folder, mend[1])
    for file in (*_files(path), *_files(path / "images")):
        kind = _kind(file)
        if kind is not None:
            return TronError(f"neither poses nor photos, but {kind[0]}", file, kind[1])
    if not any(path.iterdir()):
        return TronError(
            "folder is empty: neither poses nor photos", path, f"give a folder of one of these: {captures}"
        )
    inner = [each for each in sorted(path.iterdir()) if each.is_dir() and holds_capture(each)]
    if inner:
        others = f", or another of {len(inner)} such folders in it" if len(inner) > 1 else ""
        return TronError("neither poses nor photos", path, f"give capture={quote(str(inner[0]))}{others}")
    return TronError("neither poses nor photos", path, f"give a folder of one of these: {captures}")


def _kind(file: Path) -> tuple[str, str] | None:
    """Kind of a file or folder by its look, and what to do with it; None of an unknown kind."""
    suffix = file.suffix.lower()
    if suffix in VIDEOS:
        return "a video", f"give the file itself, capture={quote(str(file))}"
    if suffix in PACKED:
        mend = f"they are a scene already: tron-relight scene={quote(file.name)}"
        return "packed splats, not photos", mend
    if suffix in _KINDS:
        return _KINDS[suffix]
    seen = recognised(file)
    return seen and seen[:2]


def _unread(file: Path) -> tuple[str, str] | None:
    """What photos are that are not read, and what to do with them."""
    suffix = file.suffix
    if suffix.lower() in _RAW:
        return f"raw photos ({suffix}) are not read", "develop them to JPEG or TIFF, all alike"
    if suffix.lower() in _UNREAD:
        return f"photos in {suffix} are not read", "save them as JPEG, PNG or TIFF"
    return None


def _files(folder: Path) -> list[Path]:
    return sorted(each for each in folder.iterdir() if each.is_file()) if folder.is_dir() else []


def require_poses_of_photos(content: Mapping[str, Any], path: Path) -> None:
    """Raise TronError if a JSON object is a camera path of nerfstudio's viewer, not a ``transforms.json``."""
    if _CAMERA_PATH in content and "frames" not in content:
        raise TronError(
            "nerfstudio's camera path: views to render, without photos",
            path,
            "give the folder that nerfstudio was trained on, with transforms.json and its photos",
        )
