"""Frames on disk: finished exactly when whole, never mixed with frames of other settings."""

import numpy as np
import pytest

from tron.apps.frame_folder import FrameFolder
from tron.errors import TronError
from tron.io.images import read_image
from tron.seeds import generator


@pytest.fixture
def folder(tmp_path) -> FrameFolder:
    frames = FrameFolder(tmp_path / "frames", ["pbr", "depth"])
    frames.claim({"rotation": 0.0, "up": None}, overwrite=False)
    return frames


def images(seed=0):
    rng = generator(0, "test", "frames", seed)
    return {
        "pbr": rng.uniform(0, 9, (6, 8, 3)),
        "depth": rng.uniform(0, 9, (6, 8)),
        "other": np.zeros((6, 8)),
    }


def test_a_frame_is_finished_when_all_its_buffers_are_there(folder):
    assert not folder.finished(0)
    folder.write(0, images())
    assert folder.finished(0)
    assert not folder.finished(1)
    folder.path(0, "depth", "exr").unlink()
    assert not folder.finished(0)


def test_buffers_come_back(folder):
    folder.write(3, images())
    np.testing.assert_allclose(folder.read(3, "pbr"), images()["pbr"], rtol=1e-3)
    depth = read_image(folder.path(3, "depth", "exr"), channels=1)[..., 0]
    np.testing.assert_allclose(depth, images()["depth"], rtol=1e-7)  # lengths keep full precision
    assert not folder.path(3, "other", "exr").exists()


def test_a_buffer_that_is_not_finite_leaves_no_frame(folder):
    broken = images()
    broken["depth"][2, 2] = np.nan
    with pytest.raises(TronError, match="depth of frame 1 is not finite"):
        folder.write(1, broken)
    assert not list(folder.folder.glob("0001*"))


def test_the_same_settings_keep_frames_and_others_need_overwrite(folder):
    folder.write(0, images())
    folder.write_picture(0, "pbr", np.zeros((6, 8, 3)))
    folder.claim({"rotation": 0.0, "up": None}, overwrite=False)
    assert folder.finished(0)
    with pytest.raises(TronError, match=r"rotation=0\.0, not 90\.0"):
        folder.claim({"rotation": 90.0, "up": None}, overwrite=False)
    assert folder.finished(0)
    folder.claim({"rotation": 90.0, "up": None}, overwrite=True)
    assert not folder.finished(0)
    assert not list(folder.folder.glob("*.png"))
    folder.claim({"rotation": 90.0, "up": None}, overwrite=False)


def test_damaged_settings_are_refused(folder):
    (folder.folder / "settings.json").write_text("{")
    with pytest.raises(TronError, match="is damaged"):
        folder.claim({}, overwrite=False)


def test_rows_videos_and_sheets_show_every_picture_in_its_place(folder, tmp_path, read_video):
    shades = {"pbr": 0.2, "irradiance": 0.8}
    for index in range(3):
        for name, shade in shades.items():
            folder.write_picture(index, name, np.full((6, 8, 3), shade))
    row = folder.row(1, list(shades))
    np.testing.assert_allclose(row[:, :8], 0.2, atol=0.003)
    np.testing.assert_allclose(row[:, 8:], 0.8, atol=0.003)
    folder.write_video(tmp_path / "a.mp4", 3, list(shades), fps=10)
    video = read_video(tmp_path / "a.mp4")
    assert video.shape == (3, 6, 16, 3)
    assert abs(video[:, :, :6].mean() / 255 - 0.2) < 0.03
    assert abs(video[:, :, 10:].mean() / 255 - 0.8) < 0.03
    folder.write_sheet(tmp_path / "sheet.png", 3, list(shades))
    sheet = read_image(tmp_path / "sheet.png")
    for top, shade in ((18, 0.2), (26, 0.8)):  # below the headings, beside the labels, gaps of two pixels
        for left in (110, 120, 130):
            np.testing.assert_allclose(sheet[top : top + 6, left : left + 8], shade, atol=0.003)
    assert sheet[:, :110].min() < 0.5  # the labels' ink


def test_the_sheet_of_many_large_frames_is_small(folder, tmp_path):
    for index in range(20):
        folder.write_picture(index, "pbr", np.full((300, 640, 3), index / 20))
    folder.write_sheet(tmp_path / "sheet.png", 20, ["pbr"])
    sheet = read_image(tmp_path / "sheet.png")
    assert sheet.shape == (18 + 152, 110 + 6 * 322, 3)
    assert (np.diff(sheet[90, 270::322, 0]) > 0).all()
