"""What people give in place of a capture: what each of these files is, and where it belongs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tron.captures.photographs import SUFFIXES
from tron.errors import TronError

_PHOTO = ("one photo", "give the folder of all photos of the scene")
_SPLATS = (
    "compressed splats, not photos",
    "nothing is left to reconstruct: save them as a 3DGS PLY (SuperSplat does) and give it to "
    "tron-relight scene=FILE.ply",
)
_ARCHIVE = ("an archive", "unpack it and give the folder")
_ENVIRONMENT = ("an environment map, not a capture", "tron-relight environment=FILE takes it")
_MODEL = (
    "a mesh, not photos",
    "tron-datagen renders meshes (assets=FOLDER)",
)
_KINDS: dict[str, tuple[str, str]] = {
    **dict.fromkeys(SUFFIXES, _PHOTO),
    ".heic": ("a photo in HEIC", "save all photos of the scene as JPEG and give their folder"),
    **dict.fromkeys((".splat", ".spz", ".ksplat", ".sog"), _SPLATS),
    ".ply": ("a PLY of splats or points, not photos", "tron-relight scene=FILE takes splats"),
    **dict.fromkeys((".zip", ".tar", ".gz", ".tgz", ".7z"), _ARCHIVE),
    **dict.fromkeys((".hdr", ".exr"), _ENVIRONMENT),
    **dict.fromkeys((".obj", ".glb", ".gltf", ".fbx", ".stl"), _MODEL),
    **dict.fromkeys(
        (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm"),
        (
            "a video",
            "take photos out of it, two a second: mkdir photos; ffmpeg -i VIDEO -vf fps=2 -q:v 2 "
            "photos/%04d.jpg; then capture=photos matching=sequential",
        ),
    ),
    **dict.fromkeys(
        (".bin", ".db"), ("a part of a COLMAP model", "give the folder that holds sparse/0 and the photos")
    ),
}
_CAMERA_PATH = "camera_path"


def refusal(path: Path) -> TronError:
    """Error for a file other than ``.json``, or a folder without poses and photos: what there is instead."""
    if not path.is_dir():
        if path.suffix.lower() not in _KINDS:
            return TronError("a capture is a folder or a transforms.json", path)
        what, mend = _KINDS[path.suffix.lower()]
        return TronError(f"a capture is a folder or a transforms.json, this is {what}", path, mend)
    for file in (*_files(path), *_files(path / "images")):
        if file.suffix.lower() in _KINDS:
            what, mend = _KINDS[file.suffix.lower()]
            return TronError(f"neither poses nor photos, but {what}", file, mend)
    return TronError(
        "neither poses nor photos",
        path,
        "a capture has transforms.json, sparse/0, TensoIR's view folders, or photos",
    )


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
