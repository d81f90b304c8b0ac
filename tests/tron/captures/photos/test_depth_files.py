"""Depth that a transforms.json names comes out as distance along rays, sampled and never averaged."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tron.captures import Capture, LoadSettings, load_capture

STEP = (1.5, 2.25)


@pytest.fixture
def content(tmp_path: Path, photos, write) -> dict:
    """A capture whose every frame looks at two planes across its axis, the left one nearer."""
    write.photos(tmp_path / "images", photos)
    content = write.transforms(photos)
    for frame in content["frames"]:
        frame["depth_file_path"] = f"depth/{Path(frame['file_path']).name}"
    return content


def planes(size: tuple[int, int]) -> np.ndarray:
    width, height = size
    depth = np.full((height, width), STEP[1])
    depth[:, : width // 2] = STEP[0]
    return depth


def store(folder: Path, photos, write, content: dict, size: tuple[int, int], unit: float = 0.001) -> None:
    for name in photos.names:
        write.save(folder / "depth" / name, np.round(planes(size) / unit).astype(np.uint16))
    write.json(folder / "transforms.json", content)


def check(capture: Capture, scale: float = 1.0) -> None:
    for view in capture.views:
        camera, depth = view.camera, view.read("depth")
        points = camera.position + depth[..., None] * camera.rays()
        along_axis = (points - camera.position) @ camera.forward / scale
        assert set(np.round(np.unique(along_axis), 4)) == set(STEP)
        assert along_axis[:, 0] == pytest.approx(STEP[0])
        assert along_axis[:, -1] == pytest.approx(STEP[1])


def test_millimetres_along_the_axis_become_distances_along_rays(tmp_path, photos, write, content) -> None:
    store(tmp_path, photos, write, content, write.size)
    check(load_capture(tmp_path))


def test_a_smaller_map_of_the_same_shape_serves_and_so_does_a_reduced_photo(
    tmp_path, photos, write, content
) -> None:
    store(tmp_path, photos, write, content, (write.size[0] // 2, write.size[1] // 2))
    check(load_capture(tmp_path))
    check(load_capture(tmp_path, LoadSettings(downscale=3)))


def test_distortion_is_undone_in_the_depth_too(tmp_path, photos, write, content) -> None:
    """A pixel of the undistorted view takes the depth that the distorted photo has where it comes from."""
    content |= {"k1": 0.08, "k2": -0.02}
    store(tmp_path, photos, write, content, write.size)
    check(load_capture(tmp_path))


def test_the_unit_and_the_files_own_scale_count(tmp_path, photos, write, content) -> None:
    store(tmp_path, photos, write, content, write.size, unit=0.0005)
    check(load_capture(tmp_path, LoadSettings(depth_unit=0.0005)))
    content["applied_scale"] = 0.5
    store(tmp_path, photos, write, content, write.size)
    check(load_capture(tmp_path), scale=2)


def test_numpys_files_are_read_and_what_is_not_known_is_zero(tmp_path, photos, write, content) -> None:
    depth = planes(write.size) * 1000
    depth[3, :] = np.nan
    for frame, name in zip(content["frames"], photos.names):
        frame["depth_file_path"] = f"depth/{name}.npy"
        (tmp_path / "depth").mkdir(exist_ok=True)
        np.save(tmp_path / "depth" / f"{name}.npy", depth)
    write.json(tmp_path / "transforms.json", content)
    found = load_capture(tmp_path).views[0].read("depth")
    assert not found[3].any()
    assert found[4].all()


@pytest.mark.parametrize("kind", ["absent", "of another kind"])
def test_depth_that_is_not_there_is_left_out_and_told(tmp_path, photos, write, content, caplog, kind) -> None:
    store(tmp_path, photos, write, content, write.size)
    if kind == "absent":
        (tmp_path / "depth" / photos.names[2]).unlink()
    else:
        content["frames"][2]["depth_file_path"] = "depth/a.tiff"
        write.json(tmp_path / "transforms.json", content)
    capture = load_capture(tmp_path)
    assert [view.has("depth") for view in capture.views].count(False) == 1
    assert "1 maps left out, first depth of photo_02" in caplog.text


@pytest.mark.parametrize("damage", ["eight bits", "colours", "text", "another shape"])
def test_a_file_that_holds_no_depth_is_named_when_it_is_read(
    tmp_path, photos, write, content, damage
) -> None:
    from tron.errors import TronError

    store(tmp_path, photos, write, content, write.size)
    path = tmp_path / "depth" / photos.names[0]
    depth = np.round(planes(write.size) * 1000).astype(np.uint16)
    if damage == "text":
        path.write_text("no image")
    elif damage == "another shape":
        cv2.imwrite(str(path), depth[:, : write.size[0] // 3])
    else:
        cv2.imwrite(str(path), depth.astype(np.uint8) if damage == "eight bits" else np.dstack([depth] * 3))
    with pytest.raises(TronError, match=r"photo_00.png") as caught:
        load_capture(tmp_path).views[0].read("depth")
    assert "\n" not in str(caught.value)
