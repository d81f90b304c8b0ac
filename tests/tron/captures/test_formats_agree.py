"""One world point lands on the same pixel through every loader, at full size and reduced."""

from pathlib import Path

import numpy as np
import pytest

from tron.captures import Capture, LoadSettings, load_capture
from tron.errors import TronError

TOLERANCE = 1e-3


def nerf_synthetic(folder: Path, photos, write) -> None:
    """One angle, no principal point, names without suffix; so the pixels are square and centred."""
    content = write.transforms(photos, "./train/")
    frames = [{**frame, "file_path": frame["file_path"][:-4]} for frame in content["frames"]]
    angle = 2 * np.arctan(0.5 * write.size[0] / write.intrinsics[0])
    write.json(folder / "transforms_train.json", {"camera_angle_x": angle, "frames": frames})
    write.photos(folder / "train", photos, channels=4)


def per_frame(folder: Path, photos, write) -> None:
    content = write.transforms(photos)
    intrinsics = {key: content.pop(key) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    content["camera_angle_x"] = 1.0  # a frame's own focal length counts
    content["frames"] = [{**frame, **intrinsics} for frame in content["frames"]]
    write.json(folder / "transforms.json", content)
    write.photos(folder / "images", photos)


def dl3dv(folder: Path, photos, write) -> None:
    """The file speaks of ``images``, the folder has them four times smaller."""
    write.json(folder / "transforms.json", write.transforms(photos, applied=True))
    write.photos(folder / "images_8", photos, size=(12, 8))
    write.photos(folder / "images_4", photos, size=(24, 16))


def nerfstudio(folder: Path, photos, write) -> None:
    content = write.transforms(photos, applied=True)
    write.json(folder / "transforms.json", {**content, "camera_model": "OPENCV", "k1": 0.0, "p1": 0})
    write.photos(folder / "images", photos)


def instant_ngp(folder: Path, photos, write) -> None:
    write.json(folder / "transforms.json", {**write.transforms(photos, "./images/"), "aabb_scale": 4})
    write.photos(folder / "images", photos)


def colmap_binary(folder: Path, photos, write) -> None:
    write.colmap(folder / "sparse" / "0", photos, text=False)
    write.photos(folder / "images", photos)


def colmap_text(folder: Path, photos, write) -> None:
    write.colmap(folder / "colmap" / "sparse" / "0", photos, text=True)
    write.photos(folder / "images_2", photos, size=(48, 32))


def tensoir(folder: Path, photos, write) -> None:
    write.tensoir(folder, photos)


FORMATS = [nerf_synthetic, instant_ngp, nerfstudio, per_frame, dl3dv, colmap_binary, colmap_text, tensoir]


@pytest.mark.parametrize("downscale", [1, 2, 3.7])
@pytest.mark.parametrize("layout", FORMATS, ids=lambda layout: layout.__name__)
def test_a_world_point_lands_on_the_same_pixel(
    tmp_path: Path, photos, write, layout, downscale: float
) -> None:
    layout(tmp_path, photos, write)
    capture = load_capture(tmp_path, LoadSettings(downscale=downscale))
    assert not capture.skipped
    fx, fy, cx, cy = write.intrinsics
    width, height = write.size
    intrinsics = {
        "nerf_synthetic": (fx, fx, width / 2, height / 2),
        "tensoir": (0.5 * width / np.tan(0.4), 0.5 * width / np.tan(0.4), width / 2, height / 2),
    }.get(layout.__name__, (fx, fy, cx, cy))
    order = in_order(capture, layout)
    assert len(order) == len(photos.names)
    for index, view in enumerate(order):
        pixels, depth = view.camera.project(photos.points)
        size = (view.camera.width, view.camera.height)
        expected = photos.pixels(index, size, intrinsics)
        assert (depth > 0).all()
        assert np.abs(pixels - expected).max() < TOLERANCE
        assert view.read().shape == (size[1], size[0], 3)
        assert view.read()[..., 2].mean() == pytest.approx(index / 16, abs=0.01)  # and it is its own image


def in_order(capture: Capture, layout) -> list:
    """Views in the order of the cameras; TensoIR's last three are its test views."""
    if layout is not tensoir:
        return list(capture.views)
    return [*capture.train_views, *capture.test_views]


@pytest.mark.parametrize("layout", [nerfstudio, dl3dv], ids=lambda layout: layout.__name__)
def test_the_transform_takes_the_files_world_to_the_captures(tmp_path: Path, photos, write, layout) -> None:
    layout(tmp_path, photos, write)
    transform = load_capture(tmp_path).transform
    content = write.transforms(photos, applied=True)
    applied = np.array(content["applied_transform"])
    of_file = content["applied_scale"] * (photos.points @ applied[:, :3].T + applied[:, 3])
    assert np.abs(of_file @ transform[:3, :3].T + transform[:3, 3] - photos.points).max() < 1e-9


def test_max_side_reduces_to_the_longer_side_and_never_enlarges(tmp_path: Path, photos, write) -> None:
    instant_ngp(tmp_path, photos, write)
    small = load_capture(tmp_path, LoadSettings(max_side=48)).views[0].camera
    assert (small.width, small.height) == (48, 32)
    large = load_capture(tmp_path, LoadSettings(max_side=500)).views[0].camera
    assert (large.width, large.height) == write.size


def test_a_path_traced_folder_is_recognised_and_read_as_it_is(tmp_path: Path, photos, write) -> None:
    from tron.captures.folder import write_capture

    instant_ngp(tmp_path / "photos", photos, write)
    original = load_capture(tmp_path / "photos")
    write_capture(tmp_path / "traced", original)
    for path in (tmp_path / "traced", tmp_path / "traced" / "transforms.json"):
        capture = load_capture(path, LoadSettings(up=(0, 2, 0)))
        assert capture.test == original.test
        assert np.allclose(capture.up, (0, 1, 0))
        for index, view in enumerate(capture.views):
            assert np.abs(view.camera.project(photos.points)[0] - photos.pixels(index)).max() < TOLERANCE
    with pytest.raises(TronError, match="cannot be reduced"):
        load_capture(tmp_path / "traced", LoadSettings(downscale=2))
