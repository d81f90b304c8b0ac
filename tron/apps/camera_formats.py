"""Cameras of other programs, in and out: glTF, USD, COLMAP, SuperSplat; 3DGS', nerfstudio's, transforms.json.

Files for modellers (glTF, USD) stand upright: their world is that of the mesh that tron-export writes, z up
in USD's way of saying so, y up in glTF's. All others are in the frame of the scene's file. Focal lengths that
differ, and principal points off the middle, are what some formats cannot say.
"""

from __future__ import annotations

import json
import logging
import math
import struct
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tron.cameras import Camera, opencv_to_opengl, opengl_to_opencv
from tron.errors import TronError, located
from tron.io.gltf_document import Document, read_document
from tron.io.optional import usd
from tron.storage import write_atomic

log = logging.getLogger(__name__)

UPRIGHT = (".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz")
_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From a world that is z up to glTF's."""
_SUPERSPLAT = np.diag([-1.0, -1.0, 1.0, 1.0])
"""From the frame of a PLY to the world that SuperSplat shows it in, y up (its src/file-handler.ts)."""
_LARGEST_DOCUMENT = 64 * 2**20
_MOST_SAMPLES = 100_000


def read_gltf(path: Path, size: tuple[int, int], fps: float) -> list[Camera]:
    """Cameras of a glTF file's scene: the moving one at ``fps`` frames a second, or all where none moves.

    Args:
        path: .glb or .gltf. size: pixels. fps: of the frames. Cameras stand in a world that is z up.
    """
    try:
        return _of_document(read_document(path), path, size, fps)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OSError) as error:
        raise TronError(f"not a readable glTF: {error!r}", path) from error


def _of_document(document: Document, path: Path, size: tuple[int, int], fps: float) -> list[Camera]:
    nodes, cameras = document.tree.get("nodes", []), document.tree.get("cameras", [])
    parents = {child: n for n, node in enumerate(nodes) for child in node.get("children", ())}
    filming = [n for n, node in enumerate(nodes) if "camera" in node]
    if not filming:
        raise TronError("glTF file holds no camera", path, "export it with its cameras")
    tracks: dict[tuple[int, str], Callable[[float], np.ndarray]] = {}
    end = 0.0
    for animation in document.tree.get("animations", []):
        for channel in animation["channels"]:
            target, sampler = channel["target"], animation["samplers"][channel["sampler"]]
            if "node" in target and target["path"] in ("translation", "rotation", "scale"):
                times = document.meant(sampler["input"], document.stored(sampler["input"]))[:, 0]
                values = document.meant(sampler["output"], document.stored(sampler["output"]))
                track = _track(times, values, sampler.get("interpolation", "LINEAR"), target["path"])
                tracks[target["node"], target["path"]] = track
                end = max(end, float(times[-1]))

    def chain(node: int) -> list[int]:
        found = [node]
        while found[-1] in parents and len(found) <= len(nodes):
            found.append(parents[found[-1]])
        return found

    def pose(node: int, time: float) -> np.ndarray:
        matrix = np.eye(4)
        for each in chain(node):
            matrix = _local(nodes[each], each, tracks, time) @ matrix
        return matrix

    moving = [n for n in filming if any((each, kind) in tracks for each in chain(n) for kind in _PATHS)]
    count = round(end * fps) + 1
    if count > _MOST_SAMPLES:
        raise TronError(f"animation of {end:.0f} s has {count} frames", path, "cut it, or give a lower fps")
    if len(moving) > 1:
        log.info("%s: of %d cameras that move the first is followed", path, len(moving))
    asked = [(moving[0], n / fps) for n in range(count)] if moving else [(n, 0.0) for n in filming]
    with located(path):
        return [_of_vertical(pose(n, t), _yfov(cameras[nodes[n]["camera"]]), size, _Y_UP.T) for n, t in asked]


_PATHS = ("translation", "rotation", "scale")


def _yfov(camera: dict[str, Any]) -> float:
    if camera.get("type") != "perspective":
        raise TronError(f"glTF camera is {camera.get('type')}", mend="make it a perspective one")
    return float(camera["perspective"]["yfov"])


def _local(node: dict[str, Any], number: int, tracks: dict, time: float) -> np.ndarray:
    """(4, 4) of a node alone, at a time."""
    if "matrix" in node:
        return np.reshape(np.array(node["matrix"], np.float64), (4, 4)).T
    defaults = ([0.0, 0, 0], [0.0, 0, 0, 1], [1.0, 1, 1])
    shift, turn, scale = (
        tracks[number, kind](time)
        if (number, kind) in tracks
        else np.array(node.get(kind, usual), np.float64)
        for kind, usual in zip(_PATHS, defaults)
    )
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(turn).as_matrix() * scale
    matrix[:3, 3] = shift
    return matrix


def _track(times: np.ndarray, values: np.ndarray, kind: str, path: str) -> Callable[[float], np.ndarray]:
    """A sampler as a function of time (glTF 2.0, appendix C)."""
    if kind == "CUBICSPLINE":
        before, points, after = (values[part::3] for part in range(3))

        def spline(time: float) -> np.ndarray:
            k = int(np.clip(np.searchsorted(times, time, "right") - 1, 0, max(len(times) - 2, 0)))
            if len(times) == 1:
                return points[0]
            span = times[k + 1] - times[k]
            t = float(np.clip((time - times[k]) / span, 0, 1))
            return (
                (2 * t**3 - 3 * t**2 + 1) * points[k] + span * (t**3 - 2 * t**2 + t) * after[k]
                + (3 * t**2 - 2 * t**3) * points[k + 1] + span * (t**3 - t**2) * before[k + 1]
            )  # fmt: skip

        return spline
    if kind == "STEP" or len(times) == 1:
        return lambda time: values[int(np.clip(np.searchsorted(times, time, "right") - 1, 0, len(times) - 1))]
    if path == "rotation":
        slerp = Slerp(times, Rotation.from_quat(values))
        return lambda time: slerp(np.clip(time, times[0], times[-1])).as_quat()
    return lambda time: np.array([np.interp(time, times, column) for column in values.T])


def read_usd(path: Path, size: tuple[int, int], fps: float) -> list[Camera]:
    """Cameras of a USD stage: the first that moves, at ``fps`` frames a second, or all where none moves.

    Args: as of :func:`read_gltf`. A stage that refers to other files is refused.
    """
    Sdf, Usd, UsdGeom, _ = usd(str(path))
    try:
        layer = Sdf.Layer.FindOrOpen(str(path))
        outside = sorted(layer.GetCompositionAssetDependencies()) if layer else []
        if outside:
            raise TronError(f"USD stage refers to {outside[0][:80]}", path, "flatten it: usdcat --flatten")
        stage = Usd.Stage.Open(layer)
    except TronError:
        raise
    except Exception as error:  # Tf.ErrorException, which is no class to name
        raise TronError(f"not a readable USD stage: {str(error).splitlines()[0][:120]}", path) from error
    filming = [UsdGeom.Camera(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    if not filming:
        raise TronError("USD stage holds no camera", path)
    rate, upright = stage.GetTimeCodesPerSecond(), UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y

    def samples(camera: Any) -> list[float]:
        prim, found = camera.GetPrim(), set(camera.GetFocalLengthAttr().GetTimeSamples())
        while prim.IsValid() and not prim.IsPseudoRoot():
            found |= set(UsdGeom.Xformable(prim).GetTimeSamples()) if prim.IsA(UsdGeom.Xformable) else set()
            prim = prim.GetParent()
        return sorted(found)

    moving = [(camera, times) for camera in filming if len(times := samples(camera)) > 1]
    if moving:
        camera, times = moving[0]
        count = round((times[-1] - times[0]) / rate * fps) + 1
        if count > _MOST_SAMPLES:
            raise TronError(f"animation has {count} frames", path, "cut it, or give a lower fps")
        asked = [(camera, Usd.TimeCode(times[0] + n * rate / fps)) for n in range(count)]
    else:
        asked = [(camera, Usd.TimeCode.EarliestTime()) for camera in filming]
    cameras = []
    with located(path):
        for camera, time in asked:
            seen = camera.GetCamera(time)
            pose = np.array(seen.transform, np.float64).T
            angle = 2 * math.atan(seen.horizontalAperture / 2 / seen.focalLength)
            height = 2 * math.atan(math.tan(angle / 2) * size[1] / size[0])
            cameras.append(_of_vertical(pose, height, size, _Y_UP.T if upright else np.eye(4)))
    return cameras


def read_colmap(path: Path) -> list[Camera]:
    """Cameras of the COLMAP model that a file is of; lenses without their distortion."""
    from tron.captures.formats.colmap import posed_by, read_model

    try:
        posed = posed_by(read_model(path.parent))
    except ModuleNotFoundError as error:
        raise TronError("COLMAP's models need pycolmap", path, "pip install pycolmap") from error
    cameras, distorted = [], 0
    for _, pose, lens in posed:
        if callable(lens):
            raise TronError("camera of 360 degrees, which is no one view", path, "choose another path")
        numbers, two = lens.parameters, lens.model in _TWO_FOCAL
        fx, fy, cx, cy = numbers[:4] if two else (numbers[0], numbers[0], *numbers[1:3])
        distorted += any(numbers[4 if two else 3 :])
        cameras.append(Camera(fx, fy, cx, cy, round(lens.width), round(lens.height), np.linalg.inv(pose)))
    if distorted:
        log.info("%s: the lenses of %d cameras are taken without their distortion", path, distorted)
    return cameras


_TWO_FOCAL = (
    *("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE"),
    "RAD_TAN_THIN_PRISM_FISHEYE",
)
"""COLMAP's models whose first four numbers are fx, fy, cx, cy; others have f, cx, cy."""


def supersplat_document(path: Path) -> dict[str, Any]:
    """The JSON inside SuperSplat's project, .ssproj, a ZIP; nothing is unpacked."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open("document.json") as stream:
            text = stream.read(_LARGEST_DOCUMENT + 1)
        if len(text) > _LARGEST_DOCUMENT:
            raise TronError("project's document is too large", path)
        return json.loads(text)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, NotImplementedError) as error:
        raise TronError(f"not a readable project of SuperSplat: {error}", path) from error


def of_supersplat(document: dict[str, Any], size: tuple[int, int]) -> list[Camera]:
    """Key poses of SuperSplat's timeline, in the order of their frames; it goes through them on a spline.

    A pose is where the camera is and what it looks at, y up; the field of view is that of the longer side.
    """
    sets = document.get("poseSets") or []
    poses = sorted((pose for each in sets for pose in each["poses"]), key=lambda pose: pose.get("frame", 0))
    if not poses:
        raise TronError("SuperSplat's project holds no camera poses", mend="add keys to its timeline")
    common = (document.get("camera") or document.get("view") or {}).get("fov", 60.0)
    width, height = size
    cameras = []
    try:
        for pose in poses:
            longer = math.radians(float(pose.get("fov", common)))
            fov = 2 * math.degrees(math.atan(math.tan(longer / 2) * width / max(width, height)))
            camera = Camera.look_at(
                pose["position"], pose["target"], up=(0, 1, 0), fov_deg=fov, width=width, height=height
            )
            matrix = camera.world_to_camera @ _SUPERSPLAT
            cameras.append(Camera(camera.fx, camera.fy, camera.cx, camera.cy, width, height, matrix))
    except (KeyError, TypeError, ValueError) as error:
        raise TronError(f"SuperSplat's pose has an unreadable field: {error}") from error
    return cameras


def _of_vertical(pose: np.ndarray, yfov: float, size: tuple[int, int], turn: np.ndarray) -> Camera:
    """Camera of an OpenGL camera-to-world matrix, without its scale, and a vertical angle in radians."""
    pose = turn @ pose
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    if not 0 < yfov < math.pi:
        raise TronError(f"field of view is {math.degrees(yfov):.4g} degrees")
    width, height = size
    focal = 0.5 * height / math.tan(0.5 * yfov)
    return Camera(focal, focal, width / 2, height / 2, width, height, np.linalg.inv(opengl_to_opencv(pose)))


def write_camera_file(path: Path, cameras: Sequence[Camera], fps: float = 24.0) -> None:
    """Write cameras in the format that a name says, whole or not at all.

    ``transforms.json`` (NeRF, instant-ngp), ``cameras.json`` (3DGS'), ``camera_path.json`` (nerfstudio's),
    ``images.txt`` (COLMAP, with cameras.txt and an empty points3D.txt beside it), .glb and .usda (one camera
    that moves, at ``fps`` frames a second).
    """
    write = _writer(path)
    files = write(path, list(cameras), fps)
    for name, data in files.items():
        write_atomic(path.with_name(name), data)


def _writer(path: Path) -> Callable[[Path, list[Camera], float], dict[str, str | bytes]]:
    named = {
        "transforms.json": _transforms,
        "cameras.json": _graphdeco,
        "camera_path.json": _nerfstudio,
        "images.txt": _colmap,
    }
    suffixes = {".glb": _glb, ".usda": _usda}
    found = named.get(path.name.lower()) or suffixes.get(path.suffix.lower())
    if found is None:
        mend = f"use {', '.join(named)}, or NAME{', NAME'.join(suffixes)}"
        raise TronError("name says no format of cameras", path, mend)
    return found


def check_camera_file(path: Path) -> None:
    """TronError unless a name says a format that cameras are written in."""
    _writer(path)


def _json(content: Any) -> str:
    return json.dumps(content, indent=1) + "\n"


def _transforms(path: Path, cameras: list[Camera], _fps: float) -> dict[str, str | bytes]:
    frames = [
        {
            "file_path": f"images/{n:05d}.png", "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy,
            "w": c.width, "h": c.height, "transform_matrix": opencv_to_opengl(c.camera_to_world).tolist(),
        }
        for n, c in enumerate(cameras)
    ]  # fmt: skip
    return {path.name: _json({"camera_model": "PINHOLE", "frames": frames})}


def _graphdeco(path: Path, cameras: list[Camera], _fps: float) -> dict[str, str | bytes]:
    _say_centred(cameras)
    return {
        path.name: _json([
            {
                "id": n, "img_name": f"{n:05d}", "width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy,
                "position": c.position.tolist(), "rotation": c.camera_to_world[:3, :3].tolist(),
            }
            for n, c in enumerate(cameras)
        ])
    }  # fmt: skip


def _nerfstudio(path: Path, cameras: list[Camera], fps: float) -> dict[str, str | bytes]:
    _say_centred(cameras, square=True)
    first = cameras[0]
    entries = [
        {
            "camera_to_world": opencv_to_opengl(c.camera_to_world).ravel().tolist(),
            "fov": math.degrees(2 * math.atan(c.height / 2 / c.fy)), "aspect": c.width / c.height,
        }
        for c in cameras
    ]  # fmt: skip
    return {
        path.name: _json({
            "camera_type": "perspective", "render_width": first.width, "render_height": first.height,
            "fps": fps, "seconds": len(cameras) / fps, "smoothness_value": 0, "is_cycle": False, "crop": None,
            "keyframes": [], "camera_path": entries,
        })
    }  # fmt: skip


def _colmap(path: Path, cameras: list[Camera], _fps: float) -> dict[str, str | bytes]:
    lenses, images = [], []
    for n, c in enumerate(cameras, 1):
        lenses.append(f"{n} PINHOLE {c.width} {c.height} {c.fx!r} {c.fy!r} {c.cx!r} {c.cy!r}")
        x, y, z, w = Rotation.from_matrix(c.world_to_camera[:3, :3]).as_quat().tolist()
        shift = " ".join(map(repr, c.world_to_camera[:3, 3].tolist()))
        images.append(f"{n} {w!r} {x!r} {y!r} {z!r} {shift} {n} {n - 1:05d}.png\n")
    return {
        "cameras.txt": "\n".join(lenses) + "\n",
        path.name: "\n".join(images) + "\n",
        "points3D.txt": "# none\n",
    }


def _glb(path: Path, cameras: list[Camera], fps: float) -> dict[str, str | bytes]:
    """One camera with LINEAR tracks (glTF 2.0, sections 3.10.3 and 3.11), in a world that is y up."""
    _say_centred(cameras, square=True)
    if len({round(c.fy / c.height, 9) for c in cameras}) > 1:
        log.warning("%s: glTF's cameras do not zoom: all have the first one's field of view", path)
    poses = [_Y_UP @ opencv_to_opengl(c.camera_to_world) for c in cameras]
    turns = Rotation.from_matrix([pose[:3, :3] for pose in poses]).as_quat()
    times = np.arange(len(cameras), dtype="<f4") / np.float32(fps)
    parts = [times, np.array([pose[:3, 3] for pose in poses], "<f4"), turns.astype("<f4")]
    views, start = [], 0
    for part in parts:
        views.append({"buffer": 0, "byteOffset": start, "byteLength": part.nbytes})
        start += part.nbytes
    c = cameras[0]
    lens = {"yfov": 2 * math.atan(c.height / 2 / c.fy), "aspectRatio": c.width / c.height, "znear": 0.01}
    kinds = ("SCALAR", "VEC3", "VEC4")
    tree = {
        "asset": {"version": "2.0", "generator": "tron-export"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{
            "name": "camera", "camera": 0,
            "translation": parts[1][0].tolist(), "rotation": parts[2][0].tolist(),
        }],
        "cameras": [{"type": "perspective", "perspective": lens}],
        "animations": [{
            "samplers": [{"input": 0, "output": 1}, {"input": 0, "output": 2}],
            "channels": [
                {"sampler": 0, "target": {"node": 0, "path": "translation"}},
                {"sampler": 1, "target": {"node": 0, "path": "rotation"}},
            ],
        }],
        "accessors": [
            {"bufferView": n, "componentType": 5126, "count": len(cameras), "type": kind}
            for n, kind in enumerate(kinds)
        ],
        "bufferViews": views, "buffers": [{"byteLength": start}],
    }  # fmt: skip
    tree["accessors"][0] |= {"min": [float(times[0])], "max": [float(times[-1])]}
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(part.tobytes() for part in parts)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )
    return {path.name: struct.pack("<3I", 0x46546C67, 2, 12 + len(chunks)) + chunks}


def _usda(path: Path, cameras: list[Camera], fps: float) -> dict[str, str | bytes]:
    """One UsdGeomCamera with a time sample a frame; matrices are row vectors', lengths of film in tenths."""
    _say_centred(cameras, square=True)
    width = 20.955  # millimetres, USD's own default

    def samples(values: Sequence[str]) -> str:
        return "\n".join(f"            {n}: {value}," for n, value in enumerate(values))

    rows = [opencv_to_opengl(c.camera_to_world).T.tolist() for c in cameras]
    poses = ["( " + ", ".join(f"({', '.join(map(repr, row))})" for row in pose) + " )" for pose in rows]
    first = cameras[0]
    return {
        path.name: f"""#usda 1.0
(
    defaultPrim = "camera"
    startTimeCode = 0
    endTimeCode = {len(cameras) - 1}
    timeCodesPerSecond = {fps!r}
    upAxis = "Z"
)

def Camera "camera"
{{
    float horizontalAperture = {width}
    float verticalAperture = {width * first.height / first.width!r}
    float focalLength.timeSamples = {{
{samples([repr(c.fx / c.width * width) for c in cameras])}
    }}
    matrix4d xformOp:transform.timeSamples = {{
{samples(poses)}
    }}
    uniform token[] xformOpOrder = ["xformOp:transform"]
}}
"""
    }


def _say_centred(cameras: Sequence[Camera], square: bool = False) -> None:
    """A line in the log where what a format cannot say is lost."""
    off = max(max(abs(c.cx - c.width / 2) / c.width, abs(c.cy - c.height / 2) / c.height) for c in cameras)
    wide = max(abs(c.fx / c.fy - 1) for c in cameras) if square else 0.0
    if max(off, wide) > 1e-6:
        log.warning(
            "this format has centred lenses%s: the middle is off by up to %.2g of the picture",
            " and square pixels" if square else "", max(off, wide),
        )  # fmt: skip
