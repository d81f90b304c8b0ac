"""A capture folder gives back what was put in, is what nerfstudio expects, and is not fooled."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import read_capture_folder, write_capture
from tron.errors import TronError
from tron.io.images import read_image
from tron.seeds import generator
from tron.trajectories import spiral

W, H = 9, 7
SCALARS = ("roughness", "metallic")


def cameras(count: int = 3) -> list[Camera]:
    return spiral(count, target=(0.3, -0.2, 0.1), radius=3.7, width=W, height=H, fov_deg=47)


def view(name: str, camera: Camera, **changes: Any) -> View:
    """A view with every map: 8-bit values where 8 bits are stored, values of half precision elsewhere."""
    rng = generator(0, "folder", name)
    h, w = camera.height, camera.width

    def half(*shape: int) -> np.ndarray:
        return rng.random(shape).astype(np.float16).astype(np.float32)

    normal = rng.normal(size=(h, w, 3))
    fields = {
        "image": rng.integers(0, 256, (h, w, 3)) / 255,
        "space": "display",
        "mask": rng.integers(0, 256, (h, w)) / 255,
        "sky_mask": rng.integers(0, 2, (h, w)).astype(float),
        "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        "base_color": half(h, w, 3),
        "roughness": half(h, w),
        "metallic": half(h, w),
        "irradiance": 30 * half(h, w, 3),
        "depth": rng.uniform(1, 9, (h, w)).astype(np.float32),
    }
    return View(name, camera, **(fields | changes))


def capture(**changes: Any) -> Capture:
    views = tuple(view(f"view_{i}", camera) for i, camera in enumerate(cameras()))
    rng = generator(0, "points")
    fields = {
        "views": views,
        "test": {"view_1"},
        "points": rng.normal(size=(11, 3)),
        "point_colors": rng.integers(0, 256, (11, 3)) / 255,
        "up": (0.6, 0.0, 0.8),
        "exposure": 0.1234567890123,
        "transform": np.diag([2.0, 2.0, 2.0, 1.0]),
        "skipped": {"gone.png": "image not found"},
    }
    return Capture(**(fields | changes))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_capture(tmp_path / "capture", capture())
    return tmp_path / "capture"


def edited(folder: Path, change: Callable[[dict], Any]) -> Path:
    path = folder / "transforms.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    return folder


def test_what_is_read_is_what_was_written(folder: Path):
    before, after = capture(), read_capture_folder(folder)
    assert [v.name for v in after.views] == [v.name for v in before.views]
    assert after.test == before.test
    assert after.skipped == before.skipped
    assert after.exposure == before.exposure
    for name in ("up", "transform", "points", "point_colors"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    for new, old in zip(after.views, before.views):
        assert new.space == old.space
        assert {k: v for k, v in new.camera.to_dict().items() if k != "world_to_camera"} == {
            k: v for k, v in old.camera.to_dict().items() if k != "world_to_camera"
        }
        np.testing.assert_allclose(new.camera.world_to_camera, old.camera.world_to_camera, rtol=0, atol=1e-12)
        for field in ("image", "mask", "sky_mask", "base_color", "roughness", "metallic", "depth"):
            np.testing.assert_array_equal(new.read(field), old.read(field), err_msg=field)
        np.testing.assert_allclose(new.read("irradiance"), old.read("irradiance"), rtol=1e-3)
        np.testing.assert_allclose(new.read("normal"), old.read("normal"), atol=1e-3)


def test_a_capture_written_again_is_the_same_bytes(folder: Path, tmp_path: Path):
    write_capture(tmp_path / "again", read_capture_folder(folder))
    files = [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()]
    assert len(files) == 3 * 8 + 2
    for path in files:
        if path.name != "transforms.json":  # matrices pass through two products: equal to 1e-12, as above
            assert (tmp_path / "again" / path).read_bytes() == (folder / path).read_bytes(), path


def test_a_view_of_nothing_but_an_image_has_nothing_more(tmp_path: Path):
    bare = [View(f"{i}", camera, np.zeros((H, W, 3)), "display") for i, camera in enumerate(cameras())]
    write_capture(tmp_path / "bare", Capture(tuple(bare)))
    read = read_capture_folder(tmp_path / "bare" / "transforms.json")
    assert read.points is None
    for each in read.views:
        assert not any(each.has(name) for name in ("mask", "sky_mask", "normal", "depth", *SCALARS))
        assert each.read().max() == 0
    assert Image.open(tmp_path / "bare" / "images" / "0.png").mode == "RGB"


def test_linear_images_keep_what_is_brighter_than_one(tmp_path: Path):
    bright = [
        view(f"{i}", c, image=np.full((H, W, 3), 50.0), space="linear") for i, c in enumerate(cameras())
    ]
    write_capture(tmp_path / "linear", capture(views=bright, test=()))
    read = read_capture_folder(tmp_path / "linear").views[0]
    assert read.space == "linear"
    assert read.read().min() == read.read().max() == 50
    np.testing.assert_allclose(read.read("mask"), bright[0].read("mask"), atol=1e-3)


def test_cameras_of_several_sizes_have_their_own_intrinsics(tmp_path: Path):
    first, second, _ = cameras()
    other = second.resized(2 * W, 3 * H)
    write_capture(tmp_path / "mixed", Capture((view("a", first), view("b", other))))
    data = json.loads((tmp_path / "mixed" / "transforms.json").read_text())
    assert "fl_x" not in data
    assert data["frames"][1]["w"] == 2 * W
    read = read_capture_folder(tmp_path / "mixed").views[1]
    assert read.camera.fy == other.fy
    assert read.read("normal").shape == (3 * H, 2 * W, 3)


def test_a_rotation_that_is_a_little_off_keeps_its_translation(tmp_path: Path):
    matrix = np.array(cameras()[0].world_to_camera)
    matrix[:3, :3] *= 1 + 1e-5
    matrix[:3, 3] = (30.0, -20.0, 10.0)
    off = Camera(10, 10, W / 2, H / 2, W, H, matrix)
    write_capture(tmp_path / "off", Capture((view("a", off),)))
    read = read_capture_folder(tmp_path / "off").views[0].camera
    np.testing.assert_allclose(read.world_to_camera, matrix, rtol=0, atol=1e-11)


def test_a_world_point_lands_where_opengl_says(folder: Path):
    """nerfstudio's reading of the JSON, written out: camera space is x right, y up, z backward."""
    data = json.loads((folder / "transforms.json").read_text())
    points = generator(0, "world").uniform(-0.5, 0.5, (20, 3))
    for frame, old in zip(data["frames"], capture().views):
        local = (np.linalg.inv(frame["transform_matrix"]) @ np.c_[points, np.ones(20)].T).T
        assert (local[:, 2] < 0).all()
        x = data["cx"] + data["fl_x"] * local[:, 0] / -local[:, 2]
        y = data["cy"] + data["fl_y"] * local[:, 1] / local[:, 2]
        expected, depth = old.camera.project(points)
        np.testing.assert_allclose(np.c_[x, y], expected, atol=1e-9)
        np.testing.assert_allclose(-local[:, 2], depth, atol=1e-9)


def test_nerfstudio_finds_its_keys_and_files(folder: Path):
    """Keys of nerfstudio's data parser; images as Pillow, not TRON, reads them: straight colours, alpha."""
    data = json.loads((folder / "transforms.json").read_text())
    assert data["camera_model"] == "PINHOLE"
    assert (data["w"], data["h"]) == (W, H)
    assert data["train_filenames"] == ["images/view_0.png", "images/view_2.png"]
    assert data["test_filenames"] == data["val_filenames"] == ["images/view_1.png"]
    assert (folder / data["ply_file_path"]).is_file()
    for frame, old in zip(data["frames"], capture().views):
        with Image.open(folder / frame["file_path"]) as picture:
            assert picture.mode == "RGBA"
            pixels = np.asarray(picture)
        np.testing.assert_array_equal(pixels[..., :3], np.round(old.read() * 255))
        np.testing.assert_array_equal(pixels[..., 3], np.round(old.read("mask") * 255))


def test_points_are_what_another_ply_reader_sees(folder: Path):
    import plyfile

    vertex = plyfile.PlyData.read(str(folder / "points.ply"))["vertex"]
    points, colors = capture().points, capture().point_colors
    assert points is not None
    assert colors is not None
    np.testing.assert_array_equal(np.stack([vertex[k] for k in "xyz"], -1), points)
    rgb = np.stack([vertex[k] for k in ("red", "green", "blue")], -1)
    np.testing.assert_array_equal(rgb, np.round(colors * 255))


def test_nothing_is_read_before_it_is_asked_for(folder: Path):
    (folder / "images" / "view_0.png").write_bytes(b"no image")
    read = read_capture_folder(folder)
    read.views[1].read()
    with pytest.raises(TronError, match=r"not a PNG .*view_0\.png"):
        read.views[0].read()


def test_views_are_written_one_by_one(tmp_path: Path):
    """A capture of readers needs the memory of one view.

    No reader is called before the last one's view is on disk.
    """
    seen = []

    def reader(i: int) -> Callable[[], np.ndarray]:
        def read() -> np.ndarray:
            seen.append(sorted(p.name for p in tmp_path.rglob("*.png")))
            return np.zeros((H, W, 3))

        return read

    views = [View(f"{i}", camera, reader(i), "display") for i, camera in enumerate(cameras())]
    write_capture(tmp_path / "lazy", Capture(tuple(views)))
    assert seen == [[], ["0.png"], ["0.png", "1.png"]]


def test_any_name_becomes_a_file_of_its_own_within_the_folder(tmp_path: Path):
    names = ["../../a", "a", "A", "sub/a.jpg", "sub_a_jpg", "/etc/x", ".."]
    views = [view(name, camera) for name, camera in zip(names, cameras(len(names)))]
    write_capture(tmp_path / "deep" / "names", Capture(tuple(views)))
    assert [path.name for path in tmp_path.iterdir()] == ["deep"]
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["names"]
    read = read_capture_folder(tmp_path / "deep" / "names")
    assert [each.name for each in read.views] == names
    stems = [path.stem.lower() for path in (tmp_path / "deep" / "names" / "images").iterdir()]
    assert len(set(stems)) == len(names)
    for new, old in zip(read.views, views):
        np.testing.assert_array_equal(new.read(), old.read())


def test_a_folder_that_is_taken_is_kept_unless_it_is_ours_to_replace(folder: Path, tmp_path: Path):
    with pytest.raises(TronError, match="exists already"):
        write_capture(folder, capture())
    write_capture(folder, capture(test=()), overwrite=True, beside={"note.txt": b"hello"})
    assert read_capture_folder(folder).test == frozenset()
    assert (folder / "note.txt").read_bytes() == b"hello"
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "transforms.json").write_text('{"frames": []}')
    with pytest.raises(TronError, match="something else"):
        write_capture(photos, capture(), overwrite=True)
    assert [path.name for path in photos.iterdir()] == ["transforms.json"]


def test_a_capture_may_be_written_over_the_one_it_is_read_from(folder: Path):
    write_capture(folder, read_capture_folder(folder), overwrite=True)
    np.testing.assert_array_equal(
        read_capture_folder(folder).views[2].read("mask"), capture().views[2].read("mask")
    )


@pytest.mark.parametrize("name", ["transforms.json", "../x", "images", "a/b", "/x"])
def test_files_beside_may_not_take_the_place_of_others(name: str, tmp_path: Path):
    with pytest.raises(TronError, match="can be named"):
        write_capture(tmp_path / "a", capture(), beside={name: b""})
    assert list(tmp_path.iterdir()) == []


def test_a_view_that_cannot_be_read_leaves_nothing(tmp_path: Path):
    bad = view("bad", cameras()[1], irradiance=lambda: np.full((H, W, 3), np.nan))
    with pytest.raises(TronError, match=r"irradiance holds .* NaN"):
        write_capture(tmp_path / "a", Capture((view("good", cameras()[0]), bad)))
    assert list(tmp_path.iterdir()) == []


def test_colour_spaces_are_not_mixed(tmp_path: Path):
    first, second, _ = cameras()
    with pytest.raises(TronError, match="differ in colour space"):
        write_capture(tmp_path / "a", Capture((view("a", first), view("b", second, space="linear"))))


def set_path(value: str) -> Callable[[dict], Any]:
    return lambda data: data["tron"]["views"]["images/view_0.png"]["maps"].update(normal=value)


@pytest.mark.parametrize(
    "change, message",
    [
        (set_path("/etc/passwd"), "no path within"),
        (set_path("normal/../../secret.exr"), "no path within"),
        (set_path("C:\\secret.exr"), "no path within"),
        (set_path("normal\0.exr"), "no path within"),
        (set_path(""), "no path within"),
        (set_path("normal/gone.exr"), r"not there.*gone\.exr"),
        (lambda d: d["frames"][0].update(file_path="../x.png"), "no path within"),
        (lambda d: d["tron"].update(points="/points.ply"), "no path within"),
        (lambda d: d["tron"].update(version=2, new=1), "format version 2, this program reads 1"),
        (lambda d: d["tron"].update(space="srgb"), r"tron\.space"),
        (lambda d: d["tron"].update(exposure=-1), "exposure"),
        (lambda d: d["tron"].update(surprise=1), "surprise"),
        (lambda d: d["tron"].update(test=["nobody"]), "nobody"),
        (lambda d: d["tron"]["views"].clear(), "says nothing of 'images/view_0.png'"),
        (lambda d: d.pop("tron"), "not of a capture that TRON wrote"),
        (lambda d: d.pop("frames"), "frames"),
        (lambda d: d["frames"].clear(), "no views"),
        (lambda d: d["frames"].append(d["frames"][0]), "named 'view_0'"),
        (lambda d: d.pop("fl_y"), r"fl_y is missing.*view_0"),
        (lambda d: d.update(w=10**9), "w"),
        (lambda d: d.update(camera_model="OPENCV_FISHEYE"), "camera_model"),
        (lambda d: d["frames"][2].update(transform_matrix=np.zeros((4, 4)).tolist()), "view_2"),
        (lambda d: d["frames"][2].update(transform_matrix=np.full((4, 4), np.nan).tolist()), "damaged"),
        (lambda d: d["frames"][1]["transform_matrix"].pop(), "damaged"),
        (lambda d: d["frames"][2].update(transform_matrix=(2 * np.eye(4)).tolist()), r"rotation.*view_2"),
    ],
)
def test_wrong_folders_are_one_line(folder: Path, change: Callable, message: str):
    with pytest.raises(TronError, match=message) as caught:
        read_capture_folder(edited(folder, change))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize("text", ["", "[", "[1]", '{"tron": 1}', "\xff", "[" * 100_000, '{"a": NaN'])
def test_damaged_json_is_one_line(folder: Path, text: str):
    (folder / "transforms.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(TronError, match=r"transforms\.json") as caught:
        read_capture_folder(folder)
    assert "\n" not in str(caught.value)


def test_a_folder_without_its_last_file_was_not_written_to_its_end(folder: Path, tmp_path: Path):
    (folder / "transforms.json").unlink()
    for path in (folder, tmp_path / "absent"):
        with pytest.raises(TronError, match="written to its end"):
            read_capture_folder(path)


def test_links_may_not_lead_out_of_the_folder(folder: Path, tmp_path: Path):
    secret = tmp_path / "secret.exr"
    shutil.move(folder / "normal" / "view_0.exr", secret)
    (folder / "normal" / "view_0.exr").symlink_to(secret)
    with pytest.raises(TronError, match="link leads out"):
        read_capture_folder(folder)
    shutil.move(secret, folder / "inside.exr")
    (folder / "normal" / "view_0.exr").unlink()
    (folder / "normal" / "view_0.exr").symlink_to(folder / "inside.exr")
    assert read_capture_folder(folder).views[0].read("normal").shape == (H, W, 3)


def test_a_lost_alpha_is_no_mask(folder: Path):
    path = folder / "images" / "view_0.png"
    Image.fromarray((read_image(path) * 255).astype(np.uint8)).save(path)
    with pytest.raises(TronError, match="lost its alpha"):
        read_capture_folder(folder).views[0].read("mask")


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data[:-1],
        lambda data: data.replace(b"vertex 11", b"vertex 9999999999"),
        lambda data: data.replace(b"float x", b"list uchar float x"),
        lambda data: b"ply\n",
    ],
)
def test_damaged_points_are_refused(folder: Path, change: Callable[[bytes], bytes]):
    path = folder / "points.ply"
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(TronError, match="points"):
        read_capture_folder(folder)
