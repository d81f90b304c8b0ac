"""COLMAP's models: points that several photos agree on, lenses that distort, photos that were not posed."""

from pathlib import Path

import numpy as np
import pytest

from tron.captures import load_capture


@pytest.mark.parametrize("text", [False, True], ids=["bin", "txt"])
def test_points_and_their_colours(tmp_path: Path, photos, write, text: bool) -> None:
    write.colmap(tmp_path / "sparse" / "0", photos, text=text)
    write.photos(tmp_path / "images", photos)
    capture = load_capture(tmp_path)
    assert capture.points is not None
    assert capture.point_colors is not None
    assert len(capture.points) == len(photos.points) - 1  # the last was seen but twice
    order = np.round(capture.point_colors[:, 2] * 255).astype(int)
    assert np.abs(capture.points - photos.points[order]).max() < 1e-5
    assert np.allclose(capture.point_colors[:, :2], (1, 128 / 255), atol=1e-3)
    assert np.array_equal(capture.transform, np.eye(4))


def test_old_models_without_rigs_and_frames_are_read(tmp_path: Path, photos, write) -> None:
    write.colmap(tmp_path / "sparse" / "0", photos, text=False)
    for name in ("rigs.bin", "frames.bin"):
        (tmp_path / "sparse" / "0" / name).unlink()
    write.photos(tmp_path / "images", photos)
    for index, view in enumerate(load_capture(tmp_path).views):
        assert np.abs(view.camera.project(photos.points)[0] - photos.pixels(index)).max() < 1e-3


@pytest.mark.parametrize("layout", [".", "sparse", "sparse/0", "colmap/sparse/0"])
def test_models_are_found_where_tools_put_them(tmp_path: Path, photos, write, layout: str) -> None:
    root = tmp_path / "capture"
    write.photos(root / "images", photos)
    write.colmap(tmp_path / "model", photos, text=False)
    (root / layout).mkdir(parents=True, exist_ok=True)
    for file in (tmp_path / "model").iterdir():
        file.rename(root / layout / file.name)
    if layout == ".":
        (root / "images").rename(tmp_path / "images")  # beside a folder that is the model itself
    assert len(load_capture(root).views) == len(photos.names)


def test_photos_that_were_not_posed_and_poses_without_photos_are_counted(
    tmp_path: Path, photos, write
) -> None:
    write.colmap(tmp_path / "sparse" / "0", photos, text=False)
    write.photos(tmp_path / "images", photos)
    (tmp_path / "images" / photos.names[3]).unlink()
    write.save(tmp_path / "images" / "extra.png", write.picture(0))
    assert load_capture(tmp_path).skipped == {"photo_03": "image not found", "extra": "not posed by COLMAP"}


def test_a_lens_that_distorts_gives_a_pinhole(tmp_path: Path, photos, write) -> None:
    fx, _, cx, cy = write.intrinsics
    write.colmap(
        tmp_path / "sparse" / "0", photos, text=False, model="SIMPLE_RADIAL", parameters=[fx, cx, cy, -0.2]
    )
    write.photos(tmp_path / "images", photos)
    camera = load_capture(tmp_path).views[0].camera
    assert camera.fx == camera.fy
    assert 0.9 * fx < camera.fx < fx  # a barrel, straightened, shows more at the middle of its sides
    assert (camera.cx, camera.cy) == (cx, cy)
