"""Cameras of other programs come in and go out: by each one's own library, or by hand."""

import base64
import json
import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tron.apps.export import cli
from tron.cameras import Camera
from tron.errors import TronError
from tron.io.cameras.registry import UPRIGHT, cameras_of, write_camera_file
from tron.io.optional import usd

SIZE = (96, 64)
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From glTF's world, y up, to one that is z up: its -z, ahead, is +y."""


def path(n: int = 6, tilt: float = 0.3) -> list[Camera]:
    """Cameras that go round, rise and roll."""
    cameras = []
    for k in range(n):
        place = 3 * np.array([math.cos(0.5 * k), math.sin(0.5 * k), 0.2 * k])
        up = (tilt * math.sin(k), 0.1, 1.0)
        cameras.append(Camera.look_at(place, (0.1, 0.2, 0.3), up=up, fov_deg=50, width=96, height=64))
    return cameras


@pytest.mark.parametrize(
    "name", ["transforms.json", "cameras.json", "camera_path.json", "images.txt", "shot.glb", "shot.usda"]
)
def test_what_is_written_comes_back(tmp_path: Path, name: str):
    if name.endswith("usda"):
        pytest.importorskip("pxr", reason="pip install 'tron-relight[usd]'")
    write_camera_file(tmp_path / name, path())
    found = cameras_of(tmp_path / name, SIZE)
    assert len(found) == 6
    single = 1e-6 if name.endswith("glb") else 1e-9
    for one, other in zip(found, path()):
        np.testing.assert_allclose(one.world_to_camera, other.world_to_camera, atol=single)
        assert (one.fx, one.fy, one.cx, one.cy) == pytest.approx((other.fx, other.fy, 48, 32), rel=1e-6)


def test_colmaps_own_library_reads_our_text(tmp_path: Path):
    import pycolmap

    write_camera_file(tmp_path / "images.txt", path())
    model = pycolmap.Reconstruction(tmp_path)
    for number, camera in enumerate(path(), 1):
        np.testing.assert_allclose(
            model.images[number].cam_from_world().matrix(), camera.world_to_camera[:3], atol=1e-12
        )
        np.testing.assert_allclose(model.cameras[number].params, (camera.fx, camera.fy, 48, 32))


def test_usds_own_library_sees_points_where_we_do(tmp_path: Path):
    """By the frustum of Gf.Camera, whose matrices are row vectors': pixels of a world point, y up."""
    pytest.importorskip("pxr", reason="pip install 'tron-relight[usd]'")
    _, Usd, UsdGeom, Gf = usd("test")

    write_camera_file(tmp_path / "a.usda", path())
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    camera = UsdGeom.Camera(stage.GetDefaultPrim())
    point = (0.4, -0.2, 0.5)
    for n, ours in enumerate(path()):
        frustum = camera.GetCamera(n).frustum
        seen = (frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).Transform(Gf.Vec3d(*point))
        pixel = (seen[0] + 1) / 2 * 96, (1 - seen[1]) / 2 * 64
        np.testing.assert_allclose(pixel, ours.project(np.array([point]))[0][0], atol=1e-4)


def gltf(folder: Path, nodes: list, data: dict[str, np.ndarray], animation: dict) -> Path:
    """A .gltf written by hand: accessors are float32 arrays by name, in order."""
    views, accessors, blob = [], [], b""
    for values in data.values():
        part = values.astype("<f4").tobytes()
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(part)})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[1 if values.ndim == 1 else values.shape[1]]
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": 5126, "count": len(values), "type": kind}
        )
        blob += part
    uri = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    tree = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": nodes, "animations": [animation],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.8, "znear": 0.1}}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(blob), "uri": uri}],
    }  # fmt: skip
    (folder / "a.gltf").write_text(json.dumps(tree))
    return folder / "a.gltf"


@pytest.mark.parametrize("kind", ["LINEAR", "STEP", "CUBICSPLINE"])
def test_a_moving_gltf_camera_is_followed_through_its_parents(tmp_path: Path, kind: str):
    """A turntable of a quarter turn in a second under a camera that rises from 1 to 3; scale is no pose."""
    half = math.sqrt(0.5)
    rise = np.array([[0, 1.0, 4], [0, 3, 4]])
    data = {
        "times": np.array([0.0, 1.0]),
        "turn": np.array([[0, 0, 0, 1.0], [0, half, 0, half]]),
        "rise": rise,
    }
    if kind == "CUBICSPLINE":  # tangents in, value, tangents out: zero tangents ease in and out
        data["rise"] = np.stack([0 * rise, rise, 0 * rise], axis=1).reshape(6, 3)
    nodes = [{"children": [1], "scale": [2, 2, 2]}, {"camera": 0, "translation": [0, 1, 4]}]
    animation = {
        "samplers": [{"input": 0, "output": 1}, {"input": 0, "output": 2, "interpolation": kind}],
        "channels": [
            {"sampler": 0, "target": {"node": 0, "path": "rotation"}},
            {"sampler": 1, "target": {"node": 1, "path": "translation"}},
        ],
    }
    found = cameras_of(gltf(tmp_path, nodes, data, animation), SIZE, 4.0)
    assert len(found) == 5
    for n, camera in enumerate(found):
        t = n / 4
        share = {"LINEAR": t, "STEP": float(t >= 1), "CUBICSPLINE": 3 * t**2 - 2 * t**3}[kind]
        turn = Rotation.from_euler("y", 90 * t, degrees=True).as_matrix()
        np.testing.assert_allclose(camera.position, Z_UP @ turn @ [0, 2 + 4 * share, 8], atol=1e-5)
        np.testing.assert_allclose(camera.forward, Z_UP @ turn @ [0, 0, -1], atol=1e-6)
        assert camera.fy == pytest.approx(32 / math.tan(0.4))


def test_supersplats_keys_are_where_its_own_importer_puts_cameras(tmp_path: Path):
    """Its file-handler.ts turns a PLY's position (x, y, z) into (-x, -y, z), y being up there."""
    poses = [
        {"name": "b", "frame": 30, "position": [-1, -2, 3], "target": [0, 0, 0], "fov": 50},
        {"name": "a", "frame": 0, "position": [-4, 0, 0], "target": [0, 0, 0]},
    ]
    document = {"camera": {"fov": 60}, "poseSets": [{"name": "set0", "poses": poses}]}
    with zipfile.ZipFile(tmp_path / "a.ssproj", "w") as archive:
        archive.writestr("document.json", json.dumps(document))
    first, second = cameras_of(tmp_path / "a.ssproj", SIZE)
    np.testing.assert_allclose(first.position, (4, 0, 0), atol=1e-12)
    np.testing.assert_allclose(second.position, (1, 2, 3), atol=1e-12)
    np.testing.assert_allclose(second.project(np.zeros((1, 3)))[0], [[48, 32]], atol=1e-9)
    np.testing.assert_allclose(first.up, (0, -1, 0), atol=1e-12)
    assert first.fov_deg == pytest.approx(60)
    assert second.fov_deg == pytest.approx(50)


@pytest.mark.parametrize("name, data, words", [
    ("a.glb", b"glTF", "too short"),
    ("a.gltf", b'{"asset": {"version": "2.0"}}', "holds no camera"),
    ("a.gltf", b'{"asset": {"version": "2.0"}, "nodes": [{"camera": 7}]}', "not a readable glTF"),
    ("a.usda", b"#usda 1.0\n(\n subLayers = [@../../etc/passwd.usda@]\n)\n", "refers to"),
    ("a.usda", b"nothing", "not a readable USD"),
    ("a.ssproj", b"PK", "not a readable project"),
    ("images.txt", b"1 2", "COLMAP"),
])  # fmt: skip
def test_what_is_damaged_is_one_line(tmp_path: Path, name: str, data: bytes, words: str):
    if name.endswith("usda"):
        pytest.importorskip("pxr", reason="pip install 'tron-relight[usd]'")
    (tmp_path / name).write_bytes(data)
    with pytest.raises(TronError, match=words):
        cameras_of(tmp_path / name, SIZE)


@pytest.mark.parametrize("name", ["shot.glb", "images.txt"])
def test_the_command_writes_cameras_in_the_formats_frame(tmp_path: Path, ball_on_floor, name: str):
    """The scene's up is y, so its cameras are turned for modellers alone."""
    scene = ball_on_floor()
    scene.up = np.array([0.0, 1, 0])
    scene.save(tmp_path / "a.ply")
    (tmp_path / "relight.json").write_text(json.dumps([camera.to_dict() for camera in path()]))
    words = [f"scene={tmp_path}/a.ply", f"cameras={tmp_path}/relight.json", f"output={tmp_path / name}"]
    with pytest.raises(SystemExit) as stop:
        cli(words)
    assert not stop.value.code
    found = cameras_of(tmp_path / name, SIZE)
    turned = (tmp_path / name).suffix in UPRIGHT
    for one, other in zip(found, path()):
        height = one.position[2] if turned else one.position[1]
        assert height == pytest.approx(other.position[1], abs=1e-6)
    with pytest.raises(SystemExit) as stop:
        cli([*words[:2], f"output={tmp_path}/b.xyz"])
    assert stop.value.code == 2
