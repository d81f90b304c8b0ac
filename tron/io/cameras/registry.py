"""Formats of cameras, a row each: by what a file is known, how it is read, and how it is written."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tron.cameras import Camera
from tron.errors import TronError, located
from tron.io.cameras import colmap, lists, upright
from tron.io.recognised import refuse_by_sight
from tron.io.transforms_json import cameras_of_transforms
from tron.storage import write_atomic

Size = tuple[int, int]
_MEND = (
    'give a list, {"cameras": [...]} as in relight.json, cameras.json of a 3DGS model, a transforms.json, '
    "nerfstudio's camera_path.json, SuperSplat's project, COLMAP's images.txt, or a .glb or .usda"
)


class CameraFormat(NamedTuple):
    """A format.

    Attributes:
        suffixes: of files that are of this format and no other.
        read: their cameras, of a path, a size in pixels where a camera has none, and frames a second.
        tells: whether an object in JSON is of this format.
        parse: cameras of what such a file holds, its path and a size likewise.
        written: a name, or a suffix, of files that are written.
        write: what such a file holds, or by their names what it and those beside it hold.
        upright: whether its world stands upright; else it is the frame of the scene's file.
    """

    suffixes: tuple[str, ...] = ()
    read: Callable[[Path, Size, float], list[Camera]] | None = None
    tells: Callable[[dict[str, Any]], bool] | None = None
    parse: Callable[[Any, Path, Size], list[Camera]] | None = None
    written: str = ""
    write: Callable[[Path, list[Camera], float], str | bytes | Mapping[str, str]] | None = None
    upright: bool = False


def _listed(entries: Any) -> list[dict[str, Any]]:
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise TronError("no cameras found", mend=_MEND)
    return entries


def _of_list(content: Any, *_: Any) -> list[Camera]:
    return lists.of_list(_listed(content.get("cameras") if isinstance(content, dict) else content))


def _of_camera_path(content: Any, *_: Any) -> list[Camera]:
    return lists.of_camera_path(content, _listed(content["camera_path"]))


_LIST = CameraFormat(parse=_of_list, written="cameras.json", write=lists.cameras_json)
FORMATS = (
    CameraFormat(
        tells=lambda held: "frames" in held and "cameras" not in held,
        parse=lambda _, path, size: cameras_of_transforms(path, size),
        written="transforms.json", write=lists.transforms_json,
    ),
    _LIST,
    CameraFormat(
        (".ssproj",), lambda path, size, _: lists.of_supersplat(lists.supersplat_document(path), size),
        tells=lambda held: "poseSets" in held, parse=lambda held, _, size: lists.of_supersplat(held, size),
    ),
    CameraFormat(
        tells=lambda held: "camera_path" in held, parse=_of_camera_path,
        written="camera_path.json", write=lists.camera_path_json,
    ),
    CameraFormat((".txt", ".bin"), colmap.read_colmap, written="images.txt", write=colmap.images_txt),
    CameraFormat((".glb", ".gltf"), upright.read_gltf, written=".glb", write=upright.glb, upright=True),
    CameraFormat(
        (".usd", ".usda", ".usdc", ".usdz"), upright.read_usd,
        written=".usda", write=upright.usda, upright=True,
    ),
)  # fmt: skip
_BY_SUFFIX = {suffix: each for each in FORMATS for suffix in each.suffixes}
UPRIGHT = tuple(suffix for suffix, each in _BY_SUFFIX.items() if each.upright)


def cameras_of(path: Path, size: Size = (512, 512), fps: float = 24.0) -> list[Camera]:
    """Cameras of a file at their own size.

    A JSON is a list of cameras (Camera.to_dict), or an object with such a list as "cameras", as
    relight.json and the metadata of shards have it; the cameras.json of a 3DGS model; a transforms.json, in
    the world of its capture (:func:`cameras_of_transforms`); or nerfstudio's camera_path.json, whose world is
    that of the scene that nerfstudio exports (`ns-export gaussian-splat`).

    Args:
        path: the file.
        size: (width, height) in pixels of cameras that have none, as those of NeRF's transforms.json.
        fps: frames a second that cameras which move are taken at.

    Raises:
        TronError: the file is missing, of no format, or holds no camera.
    """
    known = _BY_SUFFIX.get(path.suffix.lower())
    if known is not None and known.read is not None:
        if known.upright and not path.is_file():
            raise TronError("cannot read: no such file", path)
        return known.read(path, size, fps)
    refuse_by_sight(path, "cameras are a JSON file")
    try:
        content = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    except ValueError as error:
        raise TronError(f"not JSON: {error}", path, _MEND) from error
    held = content if isinstance(content, dict) else {}
    known = next((each for each in FORMATS if each.tells is not None and each.tells(held)), _LIST)
    assert known.parse is not None
    with located(path):
        return known.parse(content, path, size)


def check_camera_file(path: Path) -> CameraFormat:
    """The format that a name says cameras are written in.

    Raises:
        TronError: it says none.
    """
    written = {each.written: each for each in FORMATS if each.written}
    found = written.get(path.name.lower()) or written.get(path.suffix.lower())
    if found is None:
        names = [each for each in written if not each.startswith(".")]
        suffixes = [each for each in written if each.startswith(".")]
        mend = f"use {', '.join(names)}, or NAME{', NAME'.join(suffixes)}"
        raise TronError("name says no format of cameras", path, mend)
    return found


def write_camera_file(path: Path, cameras: Sequence[Camera], fps: float = 24.0) -> None:
    """Write cameras in the format that a name says, whole or not at all.

    ``transforms.json`` (NeRF, instant-ngp), ``cameras.json`` (3DGS'), ``camera_path.json`` (nerfstudio's),
    ``images.txt`` (COLMAP, with cameras.txt and an empty points3D.txt beside it), .glb and .usda (one camera
    that moves, at ``fps`` frames a second).
    """
    write = check_camera_file(path).write
    assert write is not None
    made = write(path, list(cameras), fps)
    for name, data in (made if isinstance(made, Mapping) else {path.name: made}).items():
        write_atomic(path.with_name(name), data)
