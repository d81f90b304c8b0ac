"""Cameras of modellers, glTF and USD: they stand upright.

Their world is that of the mesh that tron-export writes, z up in USD's way of saying so, y up in glTF's.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tron.cameras import Camera, opencv_to_opengl, opengl_to_opencv
from tron.errors import TronError, located
from tron.io.cameras.lists import say_centred
from tron.io.gltf_document import Document, binary_file, node_matrix, read_document
from tron.io.optional import usd

log = logging.getLogger(__name__)

_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From a world that is z up to glTF's."""
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
    moved = {kind: tracks[number, kind](time) for kind in _PATHS if (number, kind) in tracks}
    return node_matrix({**node, **moved})


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


def _of_vertical(pose: np.ndarray, yfov: float, size: tuple[int, int], turn: np.ndarray) -> Camera:
    """Camera of an OpenGL camera-to-world matrix, without its scale, and a vertical angle in radians."""
    pose = turn @ pose
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    if not 0 < yfov < math.pi:
        raise TronError(f"field of view is {math.degrees(yfov):.4g} degrees")
    width, height = size
    focal = 0.5 * height / math.tan(0.5 * yfov)
    return Camera(focal, focal, width / 2, height / 2, width, height, np.linalg.inv(opengl_to_opencv(pose)))


def glb(path: Path, cameras: list[Camera], fps: float) -> bytes:
    """One camera with LINEAR tracks (glTF 2.0, sections 3.10.3 and 3.11), in a world that is y up."""
    say_centred(cameras, square=True)
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
    return binary_file(tree, b"".join(part.tobytes() for part in parts))


def usda(_path: Path, cameras: list[Camera], fps: float) -> str:
    """One UsdGeomCamera with a time sample a frame; matrices are row vectors', lengths of film in tenths."""
    say_centred(cameras, square=True)
    width = 20.955  # millimetres, USD's own default

    def samples(values: Sequence[str]) -> str:
        return "\n".join(f"            {n}: {value}," for n, value in enumerate(values))

    rows = [opencv_to_opengl(c.camera_to_world).T.tolist() for c in cameras]
    poses = ["( " + ", ".join(f"({', '.join(map(repr, row))})" for row in pose) + " )" for pose in rows]
    first = cameras[0]
    return f"""#usda 1.0
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
