"""Captures and scans at the coordinates of a map or of the earth equal the same ones about the origin."""

import json
from pathlib import Path

import numpy as np
import plyfile
import pytest
from PIL import Image

from tron.cameras import Camera, opencv_to_opengl
from tron.captures import load_capture
from tron.captures.folder import write_capture
from tron.captures.view import View
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.io.local_frame import LARGE, ORIGIN, local_origin
from tron.scans.camera_files import filmed_cameras, in_frame_of, read_cameras, write_cameras
from tron.seeds import generator

WIDTH, HEIGHT, FOCAL = 32, 24, 40.0
UTM, ECEF = np.array([448211.37, 5411738.92, 214.6]), np.array([4201796.3, 172889.1, 4780085.7])
PLACES = {"utm": UTM, "ecef": ECEF, "state plane, feet": np.array([1.3e6, 2.1e5, 900.0])}


def level(place: np.ndarray) -> np.ndarray:
    """(3,) up at a place: +z, or out of the earth (as geocentric latitude has it) for ECEF."""
    return place / np.linalg.norm(place) if place is ECEF else np.array([0.0, 0.0, 1.0])


def standing(up: np.ndarray) -> tuple[list[Camera], np.ndarray]:
    """Eight cameras about the origin, level but looking down, and points (N, 3) of a cloud of half a unit."""
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= np.linalg.norm(side)
    ahead = np.cross(up, side)
    angles = 2 * np.pi * np.arange(8) / 8
    places = 3 * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * ahead) + 1.2 * up
    size = {"fov_deg": 45.0, "width": WIDTH, "height": HEIGHT}
    points = generator(0, "test", "georeferenced").uniform(-0.5, 0.5, (50, 3))
    return [Camera.look_at(place, (0.1, 0.2, 0.0), up=up, **size) for place in places], points


def at(camera: Camera, place: np.ndarray) -> np.ndarray:
    """(4, 4) camera-to-world of a camera that stands about a place."""
    matrix = camera.camera_to_world.copy()
    matrix[:3, 3] += place
    return matrix


def write_photos(folder: Path) -> None:
    folder.mkdir(parents=True)
    for index in range(8):
        Image.new("RGB", (WIDTH, HEIGHT), (20 * index, 90, 120)).save(folder / f"{index:02d}.png")


def write_colmap(folder: Path, place: np.ndarray) -> None:
    from scipy.spatial.transform import Rotation

    cameras, points = standing(level(ECEF))
    write_photos(folder / "images")
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    camera = cameras[0]
    numbers = " ".join(map(repr, (camera.fx, camera.fy, camera.cx, camera.cy)))
    (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {numbers}\n")
    lines = []
    for index, camera in enumerate(cameras):
        pose = np.linalg.inv(at(camera, place))
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        words = " ".join(map(repr, [*quaternion.tolist(), *pose[:3, 3].tolist()]))
        lines.append(f"{index + 1} {words} 1 {index:02d}.png\n\n")
    (model / "images.txt").write_text("".join(lines))
    rows = [
        f"{i + 1} {' '.join(map(repr, row))} 9 9 9 0.1\n" for i, row in enumerate((points + place).tolist())
    ]
    (model / "points3D.txt").write_text("".join(rows))


def write_transforms(folder: Path, place: np.ndarray) -> None:
    cameras, points = standing(level(ECEF))
    write_photos(folder / "images")
    frames = [
        {"file_path": f"images/{i:02d}.png", "transform_matrix": opencv_to_opengl(at(camera, place)).tolist()}
        for i, camera in enumerate(cameras)
    ]
    camera = cameras[0]
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    rows = np.empty(len(points), [(axis, "<f8") for axis in "xyz"])
    for axis, values in zip("xyz", (points + place).T):
        rows[axis] = values
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order="<").write(
        str(folder / "p.ply")
    )
    (folder / "transforms.json").write_text(json.dumps({**lens, "ply_file_path": "p.ply", "frames": frames}))


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_a_georeferenced_capture_equals_the_same_about_the_origin(tmp_path, write, place):
    for name, where in (("here", ORIGIN), ("there", place)):
        write(tmp_path / name, where)
    here, there = load_capture(tmp_path / "here"), load_capture(tmp_path / "there")
    assert not here.offset.any()
    assert np.linalg.norm(there.offset - place) < 10
    shift = place - there.offset
    for mine, other in zip(here.views, there.views):
        np.testing.assert_allclose(other.camera.position - shift, mine.camera.position, atol=1e-8)
        np.testing.assert_allclose(other.camera.forward, mine.camera.forward, atol=1e-9)
    assert here.points is not None
    assert there.points is not None
    np.testing.assert_allclose(there.points - shift, here.points, atol=2e-6)
    np.testing.assert_allclose(there.up, here.up, atol=1e-9)
    np.testing.assert_allclose(there.up, level(ECEF), atol=0.02)
    in_file = at(standing(level(ECEF))[0][0], place)[:3, 3]
    np.testing.assert_allclose(
        there.transform[:3, :3] @ in_file + there.transform[:3, 3], there.views[0].camera.position, atol=1e-6
    )


@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_a_capture_that_is_written_stands_where_its_files_stood(tmp_path, write):
    write(tmp_path / "there", ECEF)
    capture = load_capture(tmp_path / "there")
    write_capture(tmp_path / "out", capture)
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    for frame, camera in zip(frames, standing(level(ECEF))[0]):
        np.testing.assert_allclose(
            opencv_to_opengl(np.array(frame["transform_matrix"])), at(camera, ECEF), atol=1e-6
        )
    rows = plyfile.PlyData.read(str(tmp_path / "out" / "points.ply"))["vertex"]
    stored = np.stack([rows[axis] for axis in "xyz"], axis=1)
    given = standing(level(ECEF))[1] + ECEF  # COLMAP keeps no order
    np.testing.assert_allclose(np.sort(stored, axis=0), np.sort(given, axis=0), rtol=0, atol=1e-6)
    again = load_capture(tmp_path / "out")
    np.testing.assert_array_equal(again.offset, capture.offset)
    assert again.points is not None
    assert capture.points is not None
    np.testing.assert_allclose(again.points, capture.points, atol=1e-6)
    for mine, other in zip(again.views, capture.views):
        np.testing.assert_allclose(mine.camera.world_to_camera, other.camera.world_to_camera, atol=1e-8)


@pytest.mark.parametrize(
    ("distance", "taken"), [(0, False), (1, False), (0.9 * LARGE, False), (1.1 * LARGE, True), (1e6, True)]
)
def test_only_large_coordinates_lose_their_middle(distance, taken):
    points = generator(0, "test", "cloud").uniform(-1, 1, (1000, 3))
    extent = np.linalg.norm(np.quantile(points, 0.95, axis=0) - np.quantile(points, 0.05, axis=0))
    offset = local_origin(points + distance * extent * np.array([0.6, 0.0, 0.8]))
    assert offset.any() == taken
    assert (
        not taken
        or np.linalg.norm(points + distance * extent * np.array([0.6, 0, 0.8]) - offset, axis=1).max() < 4
    )
    np.testing.assert_array_equal(offset, np.round(offset, 3))  # few digits


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((1, 3), 7.0), np.full((9, 3), 1e6)])
def test_what_has_no_extent_stays_where_it_is(points):
    assert not local_origin(points).any()


def write_splats(path: Path, place: np.ndarray, kind: str, stretch: float = 1.0) -> Path:
    """A floor of flat splats at a place, plain 3DGS."""
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21)))
    columns = {"x": stretch * x + place[0], "y": stretch * y + place[1], "z": 0.1 * x + place[2]}
    columns |= {f"f_dc_{k}": 0 * x for k in range(3)} | {"opacity": 0 * x + 4}
    columns |= {f"scale_{k}": 0 * x - (3 + 4 * (k == 2)) for k in range(3)}
    columns |= {f"rot_{k}": 0 * x + (k == 0) for k in range(4)}
    rows = np.empty(len(x), [(name, kind) for name in columns])
    for name, values in columns.items():
        rows[name] = values
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))
    return path


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_a_scan_in_doubles_has_no_slices(tmp_path, caplog, place):
    caplog.set_level("INFO")
    here = GaussianScene.load(write_splats(tmp_path / "a.ply", ORIGIN, "<f8"))
    there = GaussianScene.load(write_splats(tmp_path / "b.ply", place, "<f8"))
    assert not here.offset.any()
    np.testing.assert_allclose(there.means + (there.offset - place), here.means, atol=1e-6)
    (line,) = caplog.messages
    assert "large coordinates" in line
    there.save(tmp_path / "c.ply")
    again = GaussianScene.load(tmp_path / "c.ply")
    for name in ("means", "offset"):
        np.testing.assert_array_equal(getattr(again, name), getattr(there, name))
    there.save(tmp_path / "map.ply", on_map=True)
    rows = plyfile.PlyData.read(str(tmp_path / "map.ply"))["vertex"]
    on_map = np.stack([rows[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(on_map, there.means + there.offset, rtol=0, atol=1e-9)
    back = GaussianScene.load(tmp_path / "map.ply")
    np.testing.assert_allclose(back.means + (back.offset - there.offset), there.means, atol=1e-6)
    assert back.oriented == there.oriented
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = there.rotated(turn)
    world = (turned.means + turned.offset) @ turn
    np.testing.assert_allclose(world, there.means + there.offset, atol=1e-6)


def test_a_scan_in_floats_says_that_it_is_sliced(tmp_path, caplog):
    scene = GaussianScene.load(write_splats(tmp_path / "a.ply", UTM, "<f4"))
    assert np.abs(scene.means).max() < 10
    (line,) = (record.message for record in caplog.records if record.levelname == "WARNING")
    assert "stored in steps of 0.5, its splats are 0.05 wide" in line


def test_a_scene_about_the_origin_keeps_its_bytes(tmp_path):
    scene = GaussianScene.load(write_splats(tmp_path / "a.ply", ORIGIN, "<f4"))
    scene.save(tmp_path / "b.ply")
    assert b"offset" not in (tmp_path / "b.ply").read_bytes()[:3000]
    views = [
        View(str(i), camera, np.zeros((HEIGHT, WIDTH, 3)), "display")
        for i, camera in enumerate(standing(UTM)[0])
    ]
    write_cameras(tmp_path, views)
    assert "offset" not in (tmp_path / "cameras.json").read_text()


def listed(path: Path, place: np.ndarray, offset: np.ndarray | None = None) -> Path:
    """A file of cameras about a place; with an offset it says that this was taken away from them."""
    cameras = []
    for camera in standing(level(UTM))[0]:
        pose = np.linalg.inv(at(camera, place - (ORIGIN if offset is None else offset)))
        cameras.append(camera.to_dict() | {"world_to_camera": pose.tolist()})
    content = {"cameras": cameras} | ({} if offset is None else {"offset": offset.tolist()})
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("stands", "states"),
    [(UTM, None), (UTM, np.round(UTM)), (UTM, np.round(UTM, -2)), (UTM - np.round(UTM, 1), None)],
    ids=["map", "the same offset", "another offset", "the local frame, unsaid"],
)
def test_cameras_of_either_frame_meet_the_scene(tmp_path, stands, states):
    scene = GaussianScene.load(write_splats(tmp_path / "scene.ply", UTM, "<f8"))
    path = listed(tmp_path / "cameras.json", stands, states)
    found = in_frame_of(scene.offset, read_cameras(path, WIDTH, HEIGHT), path)
    beside = filmed_cameras(tmp_path / "scene.ply", scene.offset)
    assert beside is not None
    for truth, given, other in zip(standing(level(UTM))[0], found, beside):
        np.testing.assert_allclose(given.position + scene.offset - UTM, truth.position, atol=1e-8)
        np.testing.assert_array_equal(given.position, other.position)


def test_an_offset_that_is_none_costs_a_line(tmp_path):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"offset": [1, "east", 3]}))
    with pytest.raises(TronError, match="offset is not three finite numbers"):
        in_frame_of(ORIGIN, standing(level(UTM))[0], path)


def test_depths_of_a_georeferenced_scan_are_those_about_the_origin(tmp_path, variant):
    from tron.tracing import SurfelTracer

    depths = []
    for name, place in (("here", ORIGIN), ("there", UTM)):
        scene = GaussianScene.load(write_splats(tmp_path / f"{name}.ply", place, "<f8"))
        path = listed(tmp_path / f"{name}.json", place)
        camera = in_frame_of(scene.offset, read_cameras(path, WIDTH, HEIGHT), path)[0]
        depths.append(SurfelTracer(scene.facing(camera.position)).gbuffer(camera).numpy()["depth"])
    assert (depths[0] > 0).mean() > 0.1
    np.testing.assert_allclose(depths[1], depths[0], atol=2e-5)


@pytest.mark.parametrize("name", ["georeferenced-ply/utm_double.ply"])
def test_the_scan_of_the_field_is_exact_to_a_millimetre(shared_data, name):
    path = shared_data / "field" / name
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    scene, rows = GaussianScene.load(path), plyfile.PlyData.read(str(path))["vertex"]
    truth = np.stack([rows[axis] for axis in "xyz"], axis=1)
    assert np.abs(scene.means + scene.offset - truth).max() < 1e-6


def test_a_scan_as_wide_as_a_county_is_told_apart(tmp_path):
    """Fifty kilometres at UTM's northings: within a hundred extents, where float32 steps by half a metre."""
    scene = GaussianScene.load(write_splats(tmp_path / "wide.ply", UTM, "<f8", stretch=25_000))
    assert np.linalg.norm(scene.offset) > 1e6
