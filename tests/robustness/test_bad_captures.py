"""What is wrong with a capture costs one line, or is skipped, counted and named."""

import json
import os
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from tron.captures import LoadSettings, load_capture
from tron.errors import TronError
from tron.seeds import generator

COUNT = 6


def pixels(height: int = 24, width: int = 32) -> np.ndarray:
    return generator(0, "bad captures").integers(0, 255, (height, width, 3), np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A good transforms.json of six PNG photos."""
    (tmp_path / "images").mkdir()
    frames = []
    for index in range(COUNT):
        Image.fromarray(pixels()).save(tmp_path / "images" / f"{index}.png")
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": pose(index).tolist()})
    change(tmp_path, fl_x=30.0, w=32, h=24, frames=frames)
    return tmp_path


def pose(index: int) -> np.ndarray:
    """OpenGL camera-to-world on a ring."""
    angle = 0.5 * index
    matrix = np.eye(4)
    matrix[:3, 2] = (np.cos(angle), np.sin(angle), 0)
    matrix[:3, 1] = (0, 0, 1)
    matrix[:3, 0] = np.cross(matrix[:3, 1], matrix[:3, 2])
    matrix[:3, 3] = 3 * matrix[:3, 2]
    return matrix


def change(folder: Path, **entries: object) -> None:
    file = folder / "transforms.json"
    content = json.loads(file.read_text()) if file.exists() else {}
    file.write_text(json.dumps({**content, **entries}))


def change_frame(folder: Path, index: int, **entries: object) -> None:
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    frames[index] |= entries
    change(folder, frames=frames)


def refusal(path: Path, settings: LoadSettings | None = None) -> str:
    """The one line that loading must end with."""
    with pytest.raises(TronError) as caught:
        load_capture(path, settings or LoadSettings())
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) < 600
    return line


def mirrored() -> list:
    return (pose(2) @ np.diag([-1, 1, 1, 1])).tolist()


def with_nan() -> list:
    matrix = pose(2)
    matrix[0, 3] = np.nan
    return matrix.tolist()


BAD_POSES = {
    "nan": (with_nan(), "NaN"),
    "mirrored": (mirrored(), "mirrored"),
    "sheared": ((pose(2) + 0.3 * np.eye(4)[[1, 0, 2, 3]]).tolist(), "no rotation|last row"),
    "flattened": ((pose(2) @ np.diag([1, 1, 0, 1])).tolist(), "no rotation"),
    "zero": (np.zeros((4, 4)).tolist(), "last row|no rotation"),
    "short": ([[1, 0], [0, 1]], "shape"),
    "ragged": ([[1, 0, 0, 0], [0, 1]], "matrix of numbers"),
    "words": ("identity", "matrix of numbers|shape"),
    "absent": (None, "shape|matrix of numbers"),
    "perspective": ((pose(2) + np.array([[0] * 4] * 3 + [[1, 0, 0, 0]])).tolist(), "last row"),
}


@pytest.mark.parametrize("name", BAD_POSES)
def test_one_bad_pose_is_skipped_and_counted(
    folder: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    matrix, reason = BAD_POSES[name]
    change_frame(folder, 2, transform_matrix=matrix)
    capture = load_capture(folder)
    assert [view.name for view in capture.views] == ["0", "1", "3", "4", "5"]
    assert capture.skipped.keys() == {"2"}
    assert any(each in capture.skipped["2"] for each in reason.split("|")), capture.skipped
    assert "1 of 6 photos skipped: 2 (" in caplog.text


def test_bad_poses_alone_are_an_error(folder: Path) -> None:
    for index in range(COUNT):
        change_frame(folder, index, transform_matrix=mirrored())
    line = refusal(folder)
    assert "0 of 6 photos can be used" in line
    assert "mirrored" in line
    assert "(6)" in line


def test_a_truncated_photo_is_skipped_and_counted(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = folder / "images" / "1.jpg"
    Image.fromarray(pixels(240, 320)).save(path)
    path.write_bytes(path.read_bytes()[:-2000])
    (folder / "images" / "1.png").unlink()
    change_frame(folder, 1, file_path="images/1.jpg")
    change(folder, w=32, h=24)
    capture = load_capture(folder)
    assert capture.skipped.keys() == {"1"}
    assert "cut short" in capture.skipped["1"]
    assert "1 of 6" in caplog.text


@pytest.mark.parametrize("data", [b"", b"text", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0"])
def test_a_file_that_is_no_image_is_skipped(folder: Path, data: bytes) -> None:
    (folder / "images" / "4.png").write_bytes(data)
    assert load_capture(folder).skipped.keys() == {"4"}


def test_an_image_of_absurd_size_is_skipped_before_it_is_decoded(folder: Path) -> None:
    data = bytearray((folder / "images" / "4.png").read_bytes())
    data[16:24] = (60_000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    (folder / "images" / "4.png").write_bytes(data)
    assert load_capture(folder).skipped.keys() == {"4"}


def test_a_photo_of_another_shape_is_skipped(folder: Path) -> None:
    Image.fromarray(pixels(32, 24)).save(folder / "images" / "3.png")
    assert "its intrinsics are for 32 x 24" in load_capture(folder).skipped["3"]


def test_duplicated_names_are_skipped_but_once(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    for index in (3, 5):
        change_frame(folder, index, file_path="./images/1.png")
    capture = load_capture(folder)
    assert [view.name for view in capture.views] == ["0", "1", "2", "4"]
    assert list(capture.skipped.values()) == ["named more than once"] * 2
    assert "2 of 6" in caplog.text


def test_poses_without_images(folder: Path) -> None:
    for path in (folder / "images").iterdir():
        path.unlink()
    assert "0 of 6 photos can be used, at least 2 are needed; image not found (6)" in refusal(folder)
    (folder / "images").rmdir()
    assert "image not found (6)" in refusal(folder)


def test_a_single_usable_view(folder: Path) -> None:
    for path in sorted((folder / "images").iterdir())[1:]:
        path.unlink()
    assert "1 of 6 photos can be used, at least 2" in refusal(folder)


def test_all_views_held_out(folder: Path) -> None:
    assert "all 6 usable views are held out" in refusal(folder, LoadSettings(test_every=1))
    names = [f"images/{index}.png" for index in range(COUNT)]
    change(folder, test_filenames=names, train_filenames=[])
    assert "held out" in refusal(folder)


@pytest.mark.parametrize(
    "name", ["/etc/passwd", "../outside.png", "images/../../x.png", "C:\\photos\\a.png", "..\\x.png", ""]
)
def test_image_names_that_lead_out_of_the_folder_are_refused(folder: Path, name: str) -> None:
    change_frame(folder, 0, file_path=name)
    assert any(each in refusal(folder) for each in ("absolute", "leads out", "empty"))


@pytest.mark.parametrize(
    "text",
    ["", "{", "[1, 2]", "null", '{"frames": []}', '{"frames": {"a": 1}}', '{"frames": [3]}',
     '{"frames": [{}]}', '{"frames": [{"file_path": 7}]}', "[" * 100_000, "\udcff\udcfe"],
)  # fmt: skip
def test_json_of_another_shape(folder: Path, text: str) -> None:
    (folder / "transforms.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    assert "transforms.json" in refusal(folder)


@pytest.mark.parametrize(
    "entries, named",
    [
        ({"fl_x": "long"}, "fl_x"),
        ({"fl_x": -3.0}, "focal length"),
        ({"fl_x": None}, "camera_angle_x"),
        ({"fl_x": None, "camera_angle_x": 4.0}, "camera_angle_x"),
        ({"cx": float("nan")}, "cx"),
        ({"w": 0}, "0.0 x 24"),
        ({"camera_model": "EQUIRECTANGULAR"}, "twice as wide as high"),
        ({"k1": -50.0}, "distortion"),
        ({"k4": 0.1}, "k4"),
        ({"applied_transform": [[1, 0, 0]]}, "applied_transform"),
        ({"applied_transform": (np.diag([1, 1, -1, 1])[:3]).tolist()}, "mirrored"),
        ({"applied_transform": (np.diag([1, 2, 1, 1])[:3]).tolist()}, "applied_transform"),
        ({"applied_scale": 0}, "applied_transform"),
        ({"ply_file_path": "absent.ply"}, "absent.ply"),
        ({"ply_file_path": "../x.ply"}, "leads out"),
        ({"test_filenames": "all"}, "test_filenames"),
    ],
)
def test_intrinsics_and_settings_that_cannot_be(folder: Path, entries: dict, named: str) -> None:
    change(folder, **entries)
    assert named in refusal(folder)


def test_nothing_there(tmp_path: Path) -> None:
    assert "not found" in refusal(tmp_path / "absent")
    assert "neither poses nor photos" in refusal(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    assert "transforms.json" in refusal(tmp_path / "notes.txt")


FOREIGN = {
    "biker.splat": ("splats", "tron-relight scene="),
    "biker.spz": ("splats", "tron-relight scene="),
    "biker.ply": ("splats or points", "tron-relight scene="),
    "photos.zip": ("an archive", "unpack"),
    "venice.hdr": ("environment map", "tron-relight environment="),
    "cameras.bin": ("COLMAP", "sparse/0"),
    "a.jpg": ("one photo", "folder"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_file_that_is_no_capture_is_called_what_it_is(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"\x1f\x8b" + bytes(64))
    what, mend = FOREIGN[name]
    for settings in (LoadSettings(), LoadSettings(format="photos")):
        line = refusal(tmp_path / name, settings)
        assert name in line
        assert what in line
        assert mend in line


@pytest.mark.parametrize("inner", ["walk.mp4", "images/walk.mp4", "biker.spz", "images/walk.mov"])
def test_a_folder_without_photos_says_what_lies_in_it(tmp_path: Path, inner: str) -> None:
    (tmp_path / inner).parent.mkdir(exist_ok=True)
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / inner).write_bytes(bytes(64))
    line = refusal(tmp_path)
    assert "neither poses nor photos" in line
    assert inner in line


@pytest.mark.parametrize("kind", ["auto", "transforms"])
def test_nerfstudios_camera_path_is_called_what_it_is(tmp_path: Path, kind) -> None:
    content = {"camera_type": "perspective", "render_height": 1080, "keyframes": [], "fps": 24, "seconds": 4,
               "camera_path": [{"camera_to_world": pose(0).ravel().tolist(), "fov": 50}]}  # fmt: skip
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(content))
    line = refusal(path, LoadSettings(format=kind))
    assert "camera path" in line
    assert "transforms.json" in line


ONE_SIDE = "photos show it from"
"""What is told of these photos besides."""


def test_photos_that_max_side_reduces_are_told_in_one_line(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    Image.fromarray(pixels(48, 64)).save(folder / "images" / "2.png")
    load_capture(folder, LoadSettings(max_side=32))
    [record] = [each for each in caplog.records if ONE_SIDE not in each.getMessage()]
    assert record.levelname == "WARNING"
    assert record.getMessage().endswith(
        "max_side=32 reduces 1 of 6 photos, 64 x 48 to 32 x 24; max_side=null keeps their size"
    )


@pytest.mark.parametrize("settings", [LoadSettings(max_side=64), LoadSettings(), LoadSettings(downscale=2)])
def test_nothing_is_told_of_sizes_that_are_kept_or_asked_for(
    folder: Path, settings: LoadSettings, caplog: pytest.LogCaptureFixture
) -> None:
    load_capture(folder, settings)
    assert [record for record in caplog.records if ONE_SIDE not in record.getMessage()] == []


@pytest.mark.parametrize("kind", ["transforms", "colmap", "tensoir", "photos"])
def test_a_format_that_the_folder_does_not_have(tmp_path: Path, kind) -> None:
    (tmp_path / "notes.txt").write_text("x")
    assert str(tmp_path) in refusal(tmp_path, LoadSettings(format=kind))


def test_a_folder_of_images_that_is_absent(folder: Path) -> None:
    assert "absent" in refusal(folder, LoadSettings(images=Path("absent")))


def test_two_photos_without_poses(tmp_path: Path) -> None:
    for index in range(2):
        Image.fromarray(pixels()).save(tmp_path / f"{index}.jpg")
    (tmp_path / "2.jpg").write_bytes(b"no photo")
    line = refusal(tmp_path)
    assert "2 usable photos, 1 damaged" in line
    assert "at least 3" in line
    assert not (tmp_path / "structure_from_motion").exists()


def test_photos_without_features(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for index in range(3):
        Image.fromarray(np.full((64, 64, 3), 40 * index, np.uint8)).save(tmp_path / f"{index}.jpg")
    settings = LoadSettings(workspace=tmp_path / "work", threads=1)
    assert "none of 3 photos could be posed" in refusal(tmp_path, settings)
    assert "sfm.cc" not in capfd.readouterr().err  # a line of COLMAP's own, of C++


COLMAP_FILES = ["cameras", "images", "points3D", "rigs", "frames"]


@pytest.fixture(scope="module")
def colmap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D = 30
    path = tmp_path_factory.mktemp("colmap") / "sparse" / "0"
    path.mkdir(parents=True)
    pycolmap.set_random_seed(0)
    pycolmap.synthesize_dataset(options).write_binary(path)
    return path


@pytest.mark.parametrize("damage", ["cut", "empty", "garbage"])
@pytest.mark.parametrize("name", COLMAP_FILES)
def test_a_damaged_colmap_model(colmap: Path, tmp_path: Path, name: str, damage: str) -> None:
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    for path in colmap.iterdir():
        data = path.read_bytes()
        if path.stem == name:
            noise = generator(0, "garbage").integers(0, 256, len(data), np.uint8).tobytes()
            data = {"cut": data[: len(data) // 2], "empty": b"", "garbage": noise}[damage]
        (model / path.name).write_bytes(data)
    assert "COLMAP" in refusal(tmp_path)


def test_a_colmap_model_without_photos(colmap: Path) -> None:
    assert "image not found" in refusal(colmap.parent.parent)


def test_colmap_names_that_lead_out_of_the_folder(tmp_path: Path) -> None:
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 32 24 30 30 16 12\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 1 1 ../../../secret.png\n\n")
    (model / "points3D.txt").write_text("")
    assert "leads out" in refusal(tmp_path)


def test_a_nan_pose_in_colmaps_binary(colmap: Path, tmp_path: Path) -> None:
    """Old models keep poses with the images, new ones with the frames; the first record's x is made NaN."""
    model = tmp_path / "sparse" / "0"
    shutil.copytree(colmap, model)
    for name, at in (("images.bin", 8 + 4 + 32), ("frames.bin", 8 + 8 + 32)):
        data = bytearray((model / name).read_bytes())
        data[at : at + 8] = struct.pack("<d", np.nan)
        (model / name).write_bytes(data)
    (tmp_path / "images").mkdir()
    import pycolmap

    for image in pycolmap.Reconstruction(model).images.values():
        Image.new("RGB", (1024, 768)).save(tmp_path / "images" / image.name)
    capture = load_capture(tmp_path)
    assert len(capture.views) == 9
    assert list(capture.skipped.values()) == ["pose holds NaN or infinity"]


@pytest.mark.parametrize(
    "entries",
    [{"format": "nerf"}, {"downscale": 0.5}, {"downscale": float("nan")}, {"max_side": 0}, {"test_every": -1},
     {"matching": "random"}, {"feature_side": 1}, {"nerf": 1}, {"cache_bytes": -1}, {"up": (0, 0, 0)},
     {"up": (1, float("nan"), 0)}],
)  # fmt: skip
def test_settings_outside_their_range(entries: dict) -> None:
    with pytest.raises(ValidationError, match=next(iter(entries))):
        LoadSettings(**entries)


def test_downscale_wins_over_max_side() -> None:
    assert LoadSettings(max_side=100, downscale=2).size_of(800, 600) == (400, 300)
    assert LoadSettings(max_side=100).size_of(800, 600) == (100, 75)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read(folder: Path) -> None:
    (folder / "transforms.json").chmod(0)
    assert "cannot read" in refusal(folder)
