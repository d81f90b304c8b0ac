"""TRON's own capture folder: a nerfstudio ``transforms.json`` with one more object in it, and maps beside.

    transforms.json     intrinsics, OpenGL camera-to-world matrices, the split, and the object "tron"
    images/NAME.png     8 bits, RGBA with straight colours where a view has a mask (linear images: half EXR)
    FIELD/NAME.exr      normal, base_color, roughness, metallic, irradiance: half; depth: float32
    sky_mask/NAME.png   8 bits; valid/NAME.png likewise
    points.ply          points on surfaces and their colours, if some are known

nerfstudio and instant-ngp read the cameras, images, split and points and pass over the rest. The object
"tron" says what their format has no word for: colour space, exposure, up, which maps belong to which view.
What was taken away from large coordinates is put back, in float64, and is named as "offset".
Reading trusts nothing in the file: paths that leave the folder are refused, by name or by link.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, get_args

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, field_validator

from tron.cameras import Camera, opencv_to_opengl, opengl_to_opencv
from tron.captures.capture import Capture
from tron.captures.settings import PhotoSettings
from tron.captures.view import MAPS, ColorSpace, ToneCurve, View
from tron.errors import TronError, located
from tron.io.images import MAX_SIDE, encode_exr, encode_png, read_image
from tron.io.local_frame import ORIGIN, moved_cameras
from tron.io.transforms_json import read_json
from tron.storage import atomic_folder

TRANSFORMS_NAME = "transforms.json"
POINTS_NAME = "points.ply"
FORMAT_VERSION = 1
LARGEST_JSON = 2**28

MapName = Literal["normal", "base_color", "roughness", "metallic", "irradiance", "depth", "sky_mask", "valid"]
_MAPS: tuple[MapName, ...] = get_args(MapName)
_COLORS = ("base_color", "irradiance")
_IN_8_BITS = ("sky_mask", "valid")
_IN_FLOAT32 = ("depth",)  # half a millimetre at a metre is too coarse for surfaces
_INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
_Row = tuple[float, float, float, float]
Matrix = tuple[_Row, _Row, _Row, _Row]
_CHANNELS = ("red", "green", "blue")


def _inside(path: str) -> str:
    parts = PurePosixPath(path).parts
    if not parts or path.startswith("/") or ".." in parts or re.search(r"[\\:\x00-\x1f]", path):
        raise ValueError(f"{path[:80]!r} is no path within the folder")
    return path


InnerPath = Annotated[str, AfterValidator(_inside)]


class _Intrinsics(BaseModel):
    """Pixels; absent where the other place, top level or frame, says it. Other programs' keys are allowed."""

    model_config = ConfigDict(allow_inf_nan=False, extra="ignore")

    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: int | None = Field(None, ge=1, le=MAX_SIDE)
    h: int | None = Field(None, ge=1, le=MAX_SIDE)


class _Frame(_Intrinsics):
    """transform_matrix: OpenGL camera-to-world, (4, 4)."""

    file_path: InnerPath
    transform_matrix: Matrix


class _ViewEntry(BaseModel):
    """alpha: whether the image's alpha is the view's mask."""

    model_config = ConfigDict(extra="forbid")

    name: str
    alpha: bool
    maps: dict[MapName, InnerPath]


class _Tron(BaseModel):
    """Object of what nerfstudio's format has no word for; ``views`` is keyed by the frames' file_path.

    tone_curve: of display images; AgX where it is not said.
    """

    model_config = ConfigDict(allow_inf_nan=False, extra="forbid")

    version: int
    space: ColorSpace
    exposure: float
    up: tuple[float, float, float]
    transform: Matrix
    test: list[str]
    skipped: dict[str, str] = Field(default_factory=dict)
    points: InnerPath | None = None
    offset: tuple[float, float, float] | None = None
    tone_curve: ToneCurve | None = None
    views: dict[str, _ViewEntry]

    @field_validator("version")
    @classmethod
    def _known_version(cls, value: int) -> int:
        if value != FORMAT_VERSION:
            raise ValueError(f"format version {value}, this program reads {FORMAT_VERSION}")
        return value


class _Transforms(_Intrinsics):
    """The whole transforms.json; the lists of filenames and ply_file_path are there for nerfstudio alone."""

    camera_model: Literal["PINHOLE"]
    tron: _Tron
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    ply_file_path: str | None = None
    frames: list[_Frame]


def write_capture(
    path: str | os.PathLike[str],
    capture: Capture,
    overwrite: bool = False,
    *,
    beside: Mapping[str, bytes] | None = None,
    tone_curve: ToneCurve = "agx",
) -> None:
    """Write a capture as a folder that appears whole or not at all.

    Views are read one after another, so that a capture of readers needs the memory of one view. Images in
    display space and sky masks are stored in 8 bits, maps but depth in half precision.

    Args:
        path: the folder; its parents are made.
        capture: all its views in one colour space.
        overwrite: replace a capture folder that is there; anything else there is never touched.
        beside: more files for the folder, name -> content.
        tone_curve: that display images went through, which is said where it is not AgX.

    Raises:
        TronError: the folder is taken, views differ in colour space, a view cannot be read, or the disk says
            no.
    """
    path = Path(path)
    if len({view.space for view in capture.views}) > 1:
        raise TronError("views of a capture to be written differ in colour space", path, "convert some")
    beside = dict(beside or {})
    for name in beside:
        if name in {TRANSFORMS_NAME, POINTS_NAME, *_MAPS, "images", ".", ".."} or Path(name).name != name:
            raise TronError(f"no file of a capture folder can be named {name!r}", path)
    _require_ours(path, overwrite)
    with atomic_folder(path) as folder:
        for name, data in beside.items():
            (folder / name).write_bytes(data)
        entries = {}
        for view, stem in zip(capture.views, _stems([view.name for view in capture.views])):
            file_path, entry = _write_view(folder, view, stem)
            entries[file_path] = entry
        if capture.points is not None:
            places = capture.points + capture.offset if capture.offset.any() else capture.points
            (folder / POINTS_NAME).write_bytes(encode_points(places, capture.point_colors))
        text = _describe(capture, entries, tone_curve).model_dump_json(indent=1, exclude_none=True) + "\n"
        (folder / TRANSFORMS_NAME).write_bytes(text.encode())


def read_capture_folder(path: str | os.PathLike[str]) -> Capture:
    """Read a capture folder; images and maps are read when they are asked for.

    Args:
        path: the folder, or the transforms.json in it.

    Raises:
        TronError: no such folder, one that was not written to its end or lacks files, a transforms.json that
            is not TRON's or is damaged, or a path in it that leads out of the folder.
    """
    path = Path(path)
    folder = path.parent if path.name == TRANSFORMS_NAME else path
    transforms = _parse(folder / TRANSFORMS_NAME)
    with located(folder / TRANSFORMS_NAME):
        tron = transforms.tron
        views = []
        for frame in transforms.frames:
            entry = tron.views.get(frame.file_path)
            if entry is None:
                raise TronError(f"tron.views says nothing of {frame.file_path!r}")
            views.append(_view(folder, transforms, frame, entry))
        points = colors = None
        if tron.points is not None:
            points, colors = read_points(_existing(folder, tron.points))
            points = points if tron.offset is None else points - tron.offset
        return Capture(
            views=tuple(views),
            test=frozenset(tron.test),
            points=points,
            point_colors=colors,
            up=np.array(tron.up),
            exposure=tron.exposure,
            transform=np.array(tron.transform),
            skipped=tron.skipped,
            tone_curve=tron.tone_curve or "agx",
            offset=np.array(tron.offset or ORIGIN),
        )


def is_capture_folder(path: Path) -> bool:
    """Whether a path is a folder of :func:`write_capture`, or the transforms.json in it."""
    file = path / TRANSFORMS_NAME if path.is_dir() else path
    return file.is_file() and "tron" in read_json(file)


def load_traced(path: Path, settings: PhotoSettings) -> Capture:
    """Read a capture folder as it is: its maps hold values that resizing must not mix.

    Args:
        path: as in :func:`read_capture_folder`.
        settings: ``up`` replaces the capture's own.

    Raises:
        TronError: as :func:`read_capture_folder`, or the settings ask for smaller views.
    """
    capture = read_capture_folder(path)
    for view in capture.views:
        size = (view.camera.width, view.camera.height)
        if settings.size_of(*size) != size:
            raise TronError("path-traced views cannot be reduced", path, "render them smaller")
    if settings.up is None:
        return capture
    return replace(capture, up=np.array(settings.up) / np.linalg.norm(settings.up))


def _require_ours(path: Path, overwrite: bool) -> None:
    """Raise unless there is nothing at ``path``, or a capture folder that may be replaced."""
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not overwrite:
        raise TronError("folder exists already", path, "choose another, or ask to overwrite it")
    try:
        _parse(path / TRANSFORMS_NAME)
    except TronError as error:
        raise TronError("folder holds something else than a capture", path, "choose another") from error


def _stems(names: Sequence[str]) -> list[str]:
    """File names without suffix: the views' own as far as every system allows them, and no two alike."""
    taken: set[str] = set()
    stems = []
    for name in names:
        stem = plain = re.sub(r"[^A-Za-z0-9_-]+", "_", name)[:100].strip("-") or "view"
        number = 1
        while stem.lower() in taken:  # some disks do not tell apart upper and lower case
            number += 1
            stem = f"{plain}_{number}"
        taken.add(stem.lower())
        stems.append(stem)
    return stems


def _write_view(folder: Path, view: View, stem: str) -> tuple[str, _ViewEntry]:
    image, alpha = view.read(), view.has("mask")
    if alpha:
        image = np.concatenate([image, view.read("mask")[..., None]], axis=-1)
    file_path = f"images/{stem}{'.png' if view.space == 'display' else '.exr'}"
    _write(folder / file_path, encode_png(image) if view.space == "display" else encode_exr(image))
    maps: dict[MapName, str] = {}
    for name in _MAPS:
        if not view.has(name):
            continue
        pixels, in_8_bits = view.read(name), name in _IN_8_BITS
        maps[name] = f"{name}/{stem}{'.png' if in_8_bits else '.exr'}"
        if in_8_bits:
            data = encode_png(pixels)
        else:
            data = encode_exr(pixels, half=name not in _IN_FLOAT32, color=name in _COLORS)
        _write(folder / maps[name], data)
    return file_path, _ViewEntry(name=view.name, alpha=alpha, maps=maps)


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)


def _describe(capture: Capture, entries: Mapping[str, _ViewEntry], tone_curve: ToneCurve) -> _Transforms:
    intrinsics = [_intrinsics(view.camera) for view in capture.views]
    shared = intrinsics[0] if all(each == intrinsics[0] for each in intrinsics) else {}
    cameras = moved_cameras([view.camera for view in capture.views], capture.offset)
    frames = [
        _Frame(
            file_path=file_path,
            transform_matrix=_matrix(opencv_to_opengl(moved.camera_to_world)),
            **({} if shared else own),
        )
        for moved, own, file_path in zip(cameras, intrinsics, entries)
    ]
    train = [path for path, entry in entries.items() if entry.name not in capture.test]
    test = [path for path, entry in entries.items() if entry.name in capture.test]
    x, y, z = capture.up.tolist()
    east, north, high = capture.offset.tolist()
    points = None if capture.points is None else POINTS_NAME
    tron = _Tron(
        version=FORMAT_VERSION,
        space=capture.views[0].space,
        exposure=float(capture.exposure),
        up=(x, y, z),
        transform=_matrix(capture.transform),
        test=sorted(capture.test),
        skipped=dict(capture.skipped),
        points=points,
        offset=(east, north, high) if capture.offset.any() else None,
        tone_curve=None if tone_curve == "agx" else tone_curve,
        views=dict(entries),
    )
    return _Transforms(
        camera_model="PINHOLE",
        **shared,
        tron=tron,
        train_filenames=train if test else None,
        val_filenames=test or None,
        test_filenames=test or None,
        ply_file_path=points,
        frames=frames,
    )


def _intrinsics(camera: Camera) -> dict[str, Any]:
    values = (camera.fx, camera.fy, camera.cx, camera.cy)
    return {**dict(zip(_INTRINSICS, map(float, values))), "w": int(camera.width), "h": int(camera.height)}


def _matrix(values: np.ndarray) -> Matrix:
    return tuple(tuple(row) for row in np.asarray(values, np.float64).tolist())  # pyright: ignore


def _parse(path: Path) -> _Transforms:
    try:
        if path.stat().st_size > LARGEST_JSON:
            raise TronError(f"{TRANSFORMS_NAME} is too large to be one", path)
        text = path.read_bytes()
    except OSError as error:
        raise TronError(
            f"cannot read {TRANSFORMS_NAME}: {error.strerror or error}",
            path.parent,
            "give a capture folder that was written to its end",
        ) from error
    try:
        return _Transforms.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        if first["type"] == "missing" and field == "tron":
            raise TronError(f"{TRANSFORMS_NAME} is not of a capture that TRON wrote", path) from error
        at = f" at '{field[:80]}'" if field else ""
        raise TronError(f"{TRANSFORMS_NAME} is damaged{at}: {first['msg'][:200]}", path) from error


def _view(folder: Path, transforms: _Transforms, frame: _Frame, entry: _ViewEntry) -> View:
    image = _existing(folder, frame.file_path)
    maps = {
        name: partial(read_image, _existing(folder, inner), MAPS[name].channels, name in _COLORS)
        for name, inner in entry.maps.items()
    }
    return View(
        entry.name,
        _camera(transforms, frame, entry.name),
        partial(read_image, image, 3),
        transforms.tron.space,
        mask=partial(_read_alpha, image) if entry.alpha else None,
        **maps,
    )


def _existing(folder: Path, inner: str) -> Path:
    """The file at ``inner``, which must lie within the folder once every link is followed."""
    path = folder / inner
    if not path.resolve().is_relative_to(folder.resolve()):
        raise TronError("a link leads out of the capture folder", path, "copy the file into it")
    if not path.is_file():
        raise TronError(f"{TRANSFORMS_NAME} names a file that is not there", path, "copy the capture again")
    return path


def _read_alpha(path: Path) -> np.ndarray:
    """(H, W, 1) alpha of an image that must have it: a lost alpha is no mask of ones."""
    image = read_image(path, None)
    if image.shape[2] not in (2, 4):
        raise TronError("image has lost its alpha, which is the view's mask", path)
    return np.ascontiguousarray(image[..., -1:])


def _camera(transforms: _Transforms, frame: _Frame, name: str) -> Camera:
    values: dict[str, Any] = {}
    for key in _INTRINSICS:
        own = getattr(frame, key)
        values[key] = own if own is not None else getattr(transforms, key)
        if values[key] is None:
            raise TronError(f"{key} is missing", f"view {name}")
    camera_to_world = opengl_to_opencv(np.array(frame.transform_matrix))
    camera_to_world[:3, 3] -= transforms.tron.offset or ORIGIN
    # Rotations that are a little off are transposed twice on their way here: the translation is solved for,
    # which gives back what was written, not R R^T times it.
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = camera_to_world[:3, :3].T
    try:
        world_to_camera[:3, 3] = np.linalg.solve(camera_to_world[:3, :3], -camera_to_world[:3, 3])
        world_to_camera[3] = camera_to_world[3]
        return Camera(
            fx=values["fl_x"],
            fy=values["fl_y"],
            cx=values["cx"],
            cy=values["cy"],
            width=values["w"],
            height=values["h"],
            world_to_camera=world_to_camera,
        )
    except np.linalg.LinAlgError as error:
        raise TronError("camera matrix cannot be inverted", f"view {name}") from error
    except TronError as error:
        raise TronError(error.what, f"view {name}", error.mend) from error


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Points (N, 3) float64 and display colours (N, 3) float32, if there are any, of a PLY's vertices.

    Raises:
        TronError: no PLY, or one that is damaged or has no vertices with x, y, z.
    """
    try:
        vertex = PlyData.read(str(path))["vertex"]
        points = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
        if not {each.name for each in vertex.properties}.issuperset(_CHANNELS):
            return points, None
        stored = np.stack([vertex[channel] for channel in _CHANNELS], axis=1)
    except (OSError, TypeError, ValueError, KeyError, PlyParseError, MemoryError) as error:
        raise TronError(f"cannot read points: {error}", path) from error
    colors = stored.astype(np.float32) / (255 if np.issubdtype(stored.dtype, np.integer) else 1)
    return points, colors.clip(0, 1)


def encode_points(points: np.ndarray, colors: np.ndarray | None) -> bytes:
    """PLY of points (N, 3) in float32, or in float64 as they are, and display colours (N, 3) in 8 bits."""
    columns = [(axis, "<f8" if points.dtype == np.float64 else "<f4") for axis in "xyz"]
    if colors is not None:
        columns += [(channel, "u1") for channel in _CHANNELS]
    rows = np.empty(len(points), columns)
    for axis, values in zip("xyz", points.T):
        rows[axis] = values
    for channel, values in zip(_CHANNELS, () if colors is None else colors.T):
        rows[channel] = np.round(np.clip(values, 0, 1) * 255)
    stream = io.BytesIO()
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(stream)
    return stream.getvalue()
