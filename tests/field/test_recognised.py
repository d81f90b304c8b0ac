"""Files of other programs, given as capture, scene or cameras: read, or one line that says what they are."""

from __future__ import annotations

import json
import logging
import re
import shlex
import tarfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tron.apps.reconstruct.cli import cli as reconstruct
from tron.apps.relight.cli import cli as relight
from tron.cameras import Camera
from tron.captures import load_capture
from tron.captures.load import FORMATS
from tron.errors import TronError
from tron.gaussians.formats.registry import check_header, refuse_foreign
from tron.scans.camera_files import read_cameras

METASHAPE = '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n  <chunk label="Chunk 1">\n'
REALITY = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\nIMG_0000.jpg,1,2,3,0,0,0,26,0,0,0\n"


def photos(folder: Path) -> None:
    folder.mkdir(parents=True)
    for index in range(3):
        Image.new("RGB", (16, 16)).save(folder / f"{index}.jpg")


def polycam(path: Path) -> None:
    for name in ("images", "corrected_images"):
        photos(path / "keyframes" / name)
    for name in ("cameras", "corrected_cameras"):
        (path / "keyframes" / name).mkdir()
        (path / "keyframes" / name / "0.json").write_text("{}")
    (path / "mesh_info.json").write_text("{}")


def record3d(path: Path) -> None:
    photos(path / "rgb")
    (path / "metadata.json").write_text('{"poses": []}')


def zipped(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("images/0.jpg", b"")


def tarred(path: Path) -> None:
    path.with_suffix(".txt").write_text("x")
    with tarfile.open(path, "w:gz") as file:
        file.add(path.with_suffix(".txt"))


def model_3dgs(path: Path) -> None:
    for step in (7000, 30000):
        (path / f"point_cloud/iteration_{step}").mkdir(parents=True)
        (path / f"point_cloud/iteration_{step}/point_cloud.ply").write_text("ply")


def nerfstudio(path: Path) -> None:
    (path / "nerfstudio_models").mkdir(parents=True)
    (path / "config.yml").write_text("")


def text(content: str | bytes) -> Callable[[Path], None]:
    data = content if isinstance(content, bytes) else content.encode()

    def write(path: Path) -> None:
        path.write_bytes(data)

    return write


KNOWN: dict[str, tuple[Callable[[Path], None], list[str]]] = {
    "polycam": (polycam, ["Polycam's raw export", "tron-reconstruct capture="]),
    "record3d": (record3d, ["Record3D's export", "tron-reconstruct capture="]),
    "walk.r3d": (zipped, ["Record3D's recording", "export it in Record3D"]),
    "cameras.xml": (text(METASHAPE), ["Metashape's cameras", "tron-reconstruct capture=CAMERAS.xml"]),
    "cameras of Metashape.txt": (text("\ufeff" + METASHAPE), ["Metashape's cameras"]),
    "project.psz": (zipped, ["Metashape's project", "Export Cameras"]),
    "registration.csv": (text(REALITY), ["RealityCapture's cameras", "capture=CAMERAS.csv"]),
    "counted.csv": (text("#cameras 24\n" + REALITY), ["RealityCapture's cameras"]),
    "places.csv": (text("#name,x,y,alt,heading,pitch,roll\n"), ["RealityCapture's cameras", "camera param"]),
    "scan.rcproj": (text("<RealityCaptureProject/>"), ["RealityCapture's project", "camera parameters"]),
    "last.ckpt": (zipped, ["a checkpoint", "ns-export gaussian-splat"]),
    "chkpnt30000.pth": (zipped, ["a checkpoint", "point_cloud/iteration_N/point_cloud.ply"]),
    "splats.pt": (zipped, ["a checkpoint"]),
    "model.safetensors": (text(b"\x08\0\0\0\0\0\0\0{}"), ["a checkpoint"]),
    "scan.zip": (zipped, ["an archive", "unpack it"]),
    "scan.tar.gz": (tarred, ["an archive", "unpack it"]),
    "scan.7z": (text(b"7z\xbc\xaf\x27\x1c"), ["an archive"]),
    "nothing.xyz": (text(""), ["an empty file", "copy or download it again"]),
    "pointer.xyz": (text("version https://git-lfs.github.com/spec/v1\n"), ["Git LFS", "git lfs pull"]),
    "page.xyz": (text("<!DOCTYPE html>\n<html>"), ["a web page", "download the file"]),
    "3dgs": (model_3dgs, ["a model folder of 3DGS", "iteration_30000/point_cloud.ply takes its splats"]),
    "splatfacto": (nerfstudio, ["a trained model of nerfstudio", "ns-export gaussian-splat --load-config"]),
}
EMPTY = {"capture": "transforms.json", "scene": "scene.ply", "cameras": "cameras.json"}


READERS: dict[str, Callable[[Path], object]] = {
    "capture": load_capture,
    "scene": lambda path: (refuse_foreign(path), check_header(path)),
    "cameras": lambda path: read_cameras(path, 64, 48),
}


AS_CAPTURES = ("polycam", "record3d", "cameras.xml", "registration.csv", "counted.csv")
"""Those that are read where a capture is asked for."""


@pytest.mark.parametrize(
    ("name", "role"),
    [(name, role) for name in KNOWN for role in READERS if not (role == "capture" and name in AS_CAPTURES)],
)
def test_what_is_known_by_sight_is_one_line(tmp_path: Path, name: str, role: str) -> None:
    make, words = KNOWN[name]
    make(tmp_path / name)
    with pytest.raises(TronError) as caught:
        READERS[role](tmp_path / name)
    line = str(caught.value)
    assert [word for word in words if word not in line] == [], line
    assert str(tmp_path / name) in line


@pytest.mark.parametrize("role", EMPTY)
def test_an_empty_file_of_the_right_name_is_called_empty(tmp_path: Path, role: str) -> None:
    (tmp_path / EMPTY[role]).touch()
    with pytest.raises(TronError, match="an empty file"):
        READERS[role](tmp_path / EMPTY[role])


@pytest.mark.parametrize(
    ("role", "name"),
    [("capture", "last.ckpt"), ("capture", "nothing.xyz"), ("scene", "polycam"), ("scene", "scan.zip"),
     ("cameras", "record3d"), ("cameras", "cameras.xml")],
)  # fmt: skip
def test_the_commands_say_so(tmp_path: Path, monkeypatch, capsys, role: str, name: str) -> None:
    make, words = KNOWN[name]
    make(tmp_path / name)
    (tmp_path / "good.ply").write_text("ply\n")
    (tmp_path / "sky.hdr").touch()
    monkeypatch.setattr("tron.apps.relight.command.check_header", lambda path: None)
    given = {role: tmp_path / name, "output_dir": tmp_path / "out"}
    if role != "capture":
        given = {"scene": tmp_path / "good.ply", "environment": tmp_path / "sky.hdr"} | given
    with pytest.raises(SystemExit) as stop:
        (reconstruct if role == "capture" else relight)([f"{key}={value}" for key, value in given.items()])
    line = capsys.readouterr().err.removesuffix("\n")
    assert stop.value.code == 2, line
    assert len(line.splitlines()) == 1
    assert words[0] in line


@pytest.mark.parametrize("kind", ["polycam", "record3d", "3dgs", "splatfacto"])
def test_commands_that_a_line_names_can_be_typed(tmp_path: Path, kind: str) -> None:
    """Whatever the folder is called: the shell takes each path for one word."""
    path = tmp_path / "a (1), [b] & c" / kind
    KNOWN[kind][0](path)
    with pytest.raises(TronError) as caught:
        READERS["scene" if kind in AS_CAPTURES else "capture"](path)
    assert caught.value.mend is not None
    words = shlex.split(re.sub("[`;]", " ", caught.value.mend))
    assert any(str(path) in word for word in words), words


def test_an_empty_folder_and_one_around_a_capture(tmp_path: Path) -> None:
    with pytest.raises(TronError, match="folder is empty"):
        load_capture(tmp_path)
    photos(tmp_path / "garden" / "images")
    with pytest.raises(TronError, match=f"give capture={tmp_path / 'garden'}$"):
        load_capture(tmp_path)


@pytest.mark.parametrize("poses", ["cameras.xml", "photos/images/cameras.csv", "photos.csv", "polycam"])
def test_photos_beside_poses_that_are_not_read_are_posed_anew_with_a_line(
    tmp_path: Path, monkeypatch, caplog, poses: str
) -> None:
    monkeypatch.setattr("tron.captures.assembly.assemble", lambda *_: "assembled")
    monkeypatch.setitem(FORMATS, "photos", replace(FORMATS["photos"], read=lambda *_: "posed"))
    given = tmp_path / "photos"
    if poses == "polycam":
        polycam(tmp_path / poses)
        given = tmp_path / poses / "keyframes" / "corrected_images"
    else:
        photos(given / "images")
        (tmp_path / poses).write_text(METASHAPE if poses.endswith("xml") else REALITY)
    with caplog.at_level(logging.WARNING, "tron"):
        load_capture(given)
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 1
    assert "is not read: the photos are posed anew" in lines[0]


WHERE = [
    Camera.look_at(eye, (0.1, 0.2, 0.3), fov_deg=50, width=64, height=48) for eye in ((1, -2, 0.7), (3, 1, 1))
]
POINTS = np.array([[0.1, 0.2, 0.3], [0.4, 0.1, 0], [0, 0.5, 0.9]])


def graphdeco(camera: Camera, index: int) -> dict:
    """Entry of 3DGS' cameras.json, written out: the rows of the rotation camera-to-world, and the centre."""
    rotation = np.linalg.inv(camera.world_to_camera[:3, :3])
    position = -rotation @ camera.world_to_camera[:3, 3]
    return {
        **{"id": index, "img_name": f"{index:05d}", "width": camera.width, "height": camera.height},
        **{"position": position.tolist(), "rotation": rotation.tolist(), "fy": camera.fy, "fx": camera.fx},
    }


def frame(camera: Camera, world: np.ndarray, **own: object) -> dict:
    matrix = world @ np.linalg.inv(camera.world_to_camera) @ np.diag([1, -1, -1, 1])
    return {"file_path": "/elsewhere/of/a.png", "transform_matrix": matrix.tolist(), **own}


def transforms(top: dict, world: np.ndarray | None = None, **own: object) -> dict:
    world = np.eye(4) if world is None else world
    return top | {"frames": [frame(camera, world, **own) for camera in WHERE]}


TURN = np.array([[0.0, 0, 1, 0.5], [1, 0, 0, -2.0], [0, 1, 0, 0.25], [0, 0, 0, 1]])
FULL = {"fl_x": WHERE[0].fx, "fl_y": WHERE[0].fy, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
ANGLE = {"camera_angle_x": float(np.radians(50))}
READ: dict[str, object] = {
    "3DGS": [graphdeco(camera, index) for index, camera in enumerate(WHERE)],
    "nerfstudio": transforms(FULL),
    "a lens a frame": transforms({}, **FULL),
    "NeRF, without a size": transforms(ANGLE),
    "a lens that distorts": transforms(FULL | {"k1": -0.1, "camera_model": "OPENCV"}),
    "applied_transform": transforms(FULL | {"applied_transform": TURN[:3].tolist()}, TURN),
    "applied_scale": transforms(
        FULL | {"applied_transform": TURN[:3].tolist(), "applied_scale": 0.5},
        np.diag([0.5, 0.5, 0.5, 1]) @ TURN,
    ),
}


@pytest.mark.parametrize("kind", READ)
def test_cameras_of_other_programs_show_the_same_view(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(READ[kind]))
    found = read_cameras(path, 128, 96)
    assert len(found) == len(WHERE)
    for camera, given in zip(found, WHERE):
        assert (camera.width, camera.height) == (128, 96)
        np.testing.assert_allclose(camera.project(POINTS)[0], 2 * given.project(POINTS)[0], atol=1e-4)


def damaged(**changes: object) -> list[dict]:
    return [graphdeco(WHERE[0], 0) | changes]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([{k: v for k, v in damaged()[0].items() if k != "position"}], "lacks the field 'position'"),
        (damaged(rotation=[[1, 0], [0, 1]]), "unreadable field"),
        (damaged(rotation=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]), "no rotation"),
        (damaged(rotation=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]), "mirrored"),
        (damaged(fx=0), "positive focal lengths"),
        (transforms({}), "no focal length"),
        ({"frames": []}, "no list of frames"),
        ({"frames": [{"file_path": "a.png"}], **FULL}, "pose"),
    ],
)
def test_cameras_that_cannot_be_used_are_one_line(tmp_path: Path, content: object, said: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(content))
    with pytest.raises(TronError, match=said) as caught:
        read_cameras(path, 64, 48)
    assert str(path) in str(caught.value)


def test_the_cameras_that_were_reported(shared_data: Path) -> None:
    path = shared_data / "field" / "graphdeco-cameras" / "cameras.json"
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    cameras = read_cameras(path, 64, 64)
    assert len(cameras) == 6
    middle = np.mean([camera.position for camera in cameras], axis=0)
    assert all(
        camera.project(middle[None])[1] > 0 for camera in cameras
    )  # they stand around it and look at it
