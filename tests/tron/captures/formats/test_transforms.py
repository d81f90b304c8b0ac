"""Dialects and traps of transforms.json."""

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from tron.captures import LoadSettings, load_capture


@pytest.fixture
def capture(tmp_path: Path, photos, write) -> dict:
    """A good capture in ``tmp_path``; the content of its file, to be changed and written again."""
    write.photos(tmp_path / "images", photos)
    content = write.transforms(photos)
    write.json(tmp_path / "transforms.json", content)
    return content


def test_a_uniform_scale_of_the_axes_is_divided_out(tmp_path: Path, photos, write, capture: dict) -> None:
    for frame in capture["frames"]:
        matrix = np.array(frame["transform_matrix"])
        matrix[:3, :3] *= 0.37
        frame["transform_matrix"] = matrix[:3].tolist()  # three rows are as good as four
    write.json(tmp_path / "transforms.json", capture)
    for index, view in enumerate(load_capture(tmp_path).views):
        assert np.abs(view.camera.project(photos.points)[0] - photos.pixels(index)).max() < 1e-6


def test_rounded_matrices_are_made_rotations(tmp_path: Path, photos, write, capture: dict) -> None:
    for frame in capture["frames"]:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 3).tolist()
    write.json(tmp_path / "transforms.json", capture)
    for index, view in enumerate(load_capture(tmp_path).views):
        assert np.abs(view.camera.project(photos.points)[0] - photos.pixels(index)).max() < 0.2


def test_nerf_synthetics_files_are_the_split(tmp_path: Path, photos, write) -> None:
    content = write.transforms(photos, "./")
    for split, part in (("train", slice(6)), ("test", slice(6, 9)), ("val", slice(9, 10))):
        frames = [
            {**frame, "file_path": f"./{split}/r_{index}"}
            for index, frame in enumerate(content["frames"][part])
        ]
        write.json(tmp_path / f"transforms_{split}.json", {"camera_angle_x": 0.7, "frames": frames})
        for index in range(len(frames)):
            write.save(tmp_path / split / f"r_{index}.png", write.picture(index, channels=4))
    loaded = load_capture(tmp_path)
    assert [view.name for view in loaded.test_views] == ["test/r_0", "test/r_1", "test/r_2"]
    assert [view.name for view in loaded.train_views] == [f"train/r_{index}" for index in range(6)]
    assert loaded.views[0].has("mask")
    assert loaded.views[0].read("mask").min() == 1
    alone = load_capture(tmp_path / "transforms_train.json")
    assert [view.name for view in alone.test_views] == ["r_0"]


def test_nerfstudios_lists_are_the_split(tmp_path: Path, write, capture: dict) -> None:
    names = [frame["file_path"] for frame in capture["frames"]]
    lists = {"train_filenames": names[:5], "val_filenames": names[5:6], "test_filenames": names[6:9]}
    write.json(tmp_path / "transforms.json", {**capture, **lists})
    loaded = load_capture(tmp_path)
    assert loaded.test == {"photo_06", "photo_07", "photo_08"}
    assert len(loaded.train_views) == 5
    assert loaded.skipped.keys() == {"photo_05", "photo_09"}
    write.json(
        tmp_path / "transforms.json", {**capture, "train_filenames": names[:8], "val_filenames": names[8:]}
    )
    assert load_capture(tmp_path).test == {"photo_08", "photo_09"}


def test_test_every_zero_holds_out_none(tmp_path: Path, capture: dict) -> None:
    assert not load_capture(tmp_path, LoadSettings(test_every=0)).test
    assert load_capture(tmp_path, LoadSettings(test_every=3)).test == {f"photo_0{i}" for i in (0, 3, 6, 9)}


def test_points_come_along_from_the_files_world(tmp_path: Path, photos, write) -> None:
    write.photos(tmp_path / "images", photos)
    content = write.transforms(photos, applied=True)
    applied = np.array(content["applied_transform"])
    in_file = content["applied_scale"] * (photos.points @ applied[:, :3].T + applied[:, 3])
    fields = [*((axis, "f4") for axis in "xyz"), *((color, "u1") for color in ("red", "green", "blue"))]
    vertices = np.zeros(len(in_file), fields)
    for column, axis in enumerate("xyz"):
        vertices[axis] = in_file[:, column]
    vertices["red"] = 255
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(tmp_path / "sparse_pc.ply"))
    write.json(tmp_path / "transforms.json", {**content, "ply_file_path": "sparse_pc.ply"})
    loaded = load_capture(tmp_path)
    assert loaded.points is not None
    assert np.abs(loaded.points - photos.points).max() < 1e-5
    assert loaded.point_colors is not None
    assert np.array_equal(loaded.point_colors[0], (1, 0, 0))


def test_a_colmap_model_beside_the_file_gives_points_if_its_cameras_agree(
    tmp_path: Path, photos, write
) -> None:
    write.photos(tmp_path / "images", photos)
    write.colmap(tmp_path / "colmap" / "sparse" / "0", photos, text=False)
    write.json(tmp_path / "transforms.json", write.transforms(photos, applied=True))
    points = load_capture(tmp_path).points
    assert points is not None
    distance = np.linalg.norm(points[:, None] - photos.points, axis=-1).min(1)
    assert distance.max() < 1e-6
    moved = write.transforms(photos, applied=True)
    moved["applied_transform"] = np.eye(4)[:3].tolist()  # a lie: the cameras now stand elsewhere
    write.json(tmp_path / "transforms.json", moved)
    assert load_capture(tmp_path).points is None


def test_images_of_mixed_sizes_have_cameras_of_their_own(
    tmp_path: Path, photos, write, capture: dict
) -> None:
    width, height = write.size
    for name in photos.names[::2]:
        write.save(tmp_path / "images" / name, write.picture(0, (width // 2, height // 2)))
    for index, view in enumerate(load_capture(tmp_path).views):
        size = (view.camera.width, view.camera.height)
        assert size == ((width // 2, height // 2) if index % 2 == 0 else (width, height))
        assert np.abs(view.camera.project(photos.points)[0] - photos.pixels(index, size)).max() < 1e-6


def test_another_folder_of_images_can_be_named(tmp_path: Path, photos, write, capture: dict) -> None:
    write.photos(tmp_path / "elsewhere", photos, size=(48, 32))
    for images in ("elsewhere", str(tmp_path / "elsewhere")):
        camera = load_capture(tmp_path, LoadSettings(images=Path(images))).views[0].camera
        assert (camera.width, camera.height) == (48, 32)


def test_another_suffix_is_found(tmp_path: Path, photos, write, capture: dict) -> None:
    (tmp_path / "images" / "photo_00.png").rename(tmp_path / "images" / "photo_00.JPG")
    assert len(load_capture(tmp_path).views) == len(photos.names)


def test_names_keep_their_suffix_where_they_must(tmp_path: Path, write, capture: dict) -> None:
    frame = {**capture["frames"][1], "file_path": "images/photo_00.tif"}
    capture["frames"].append(frame)
    write.json(tmp_path / "transforms.json", capture)
    write.save(tmp_path / "images" / "photo_00.tif", write.picture(1))
    names = [view.name for view in load_capture(tmp_path).views]
    assert {"photo_00.png", "photo_00.tif", "photo_01"} <= set(names)


def test_an_up_direction_can_be_said(tmp_path: Path, capture: dict) -> None:
    assert np.allclose(load_capture(tmp_path, LoadSettings(up=(0, 3, 0))).up, (0, 1, 0))


def test_views_that_blender_nerf_logs_and_does_not_render_are_no_test_views(
    tmp_path: Path, photos, write
) -> None:
    """The add-on writes poses of test views whether or not it draws their pictures."""
    write.json(tmp_path / "transforms_train.json", write.transforms(photos, "images_train/"))
    write.json(tmp_path / "transforms_test.json", write.transforms(photos, "images_test/"))
    write.photos(tmp_path / "images_train", photos)
    capture = load_capture(tmp_path)
    assert len(capture.views) == len(photos.names)
    assert len(capture.test) == 2  # every eighth
    assert set(capture.skipped.values()) == {"image not found"}
    write.photos(tmp_path / "images_test", photos)
    assert len(load_capture(tmp_path).test_views) == len(photos.names)
