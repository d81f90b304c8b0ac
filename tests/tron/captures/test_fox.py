"""The one real capture: a phone's photos with lens distortion, and a file that names more than there are."""

from pathlib import Path

import numpy as np
import pytest

from tron.captures import Capture, LoadSettings, load_capture


@pytest.fixture(scope="module")
def folder(shared_data: Path) -> Path:
    path = shared_data / "captures" / "fox"
    if not path.is_dir():
        pytest.skip(f"no real capture: {path} is absent")
    return path


@pytest.fixture(scope="module")
def fox(folder: Path) -> Capture:
    return load_capture(folder, LoadSettings(downscale=8))


def test_photos_that_are_absent_are_counted(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    fox = load_capture(folder, LoadSettings(downscale=8))
    assert len(fox.views) == 50
    assert len(fox.skipped) == 17
    assert set(fox.skipped.values()) == {"image not found"}
    line, sides = [record.getMessage() for record in caplog.records]
    assert "from 91 degrees around" in sides
    assert "17 of 67 photos skipped: 0005 (image not found)" in line
    assert "\n" not in line


def test_every_eighth_is_held_out(fox: Capture) -> None:
    names = [view.name for view in fox.views]
    assert names == sorted(names)
    assert names[0] == "0001"
    assert [view.name for view in fox.test_views] == names[::8]


def test_cameras_are_plausible(fox: Capture) -> None:
    positions = np.stack([view.camera.position for view in fox.views])
    assert np.isfinite(positions).all()
    for view in fox.views:
        assert (view.camera.width, view.camera.height) == (135, 240)
        assert view.camera.fx == pytest.approx(1375 / 8, rel=0.03)
        assert view.camera.fx == pytest.approx(view.camera.fy)
    # instant-ngp turned the world so that up is +z; the photographer held the phone level within a little.
    assert fox.up[2] > np.cos(np.radians(8))
    assert min(view.camera.up @ fox.up for view in fox.views) > 0.7
    # Lines of sight meet near the fox, in front of every camera.
    directions = np.stack([view.camera.forward for view in fox.views])
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None]
    target = np.linalg.solve(projectors.sum(0), (projectors @ positions[..., None]).sum(0)[:, 0])
    assert (((target - positions) * directions).sum(1) > 0).all()


def test_pictures_are_read_small(fox: Capture) -> None:
    for view in list(fox.views)[::16]:
        image = view.read()
        assert image.shape == (240, 135, 3)
        assert 0.1 < image.mean() < 0.9
        assert image.std() > 0.1
    assert fox.views[0].image.__self__.cache.n_bytes < 2**25  # type: ignore[union-attr]
