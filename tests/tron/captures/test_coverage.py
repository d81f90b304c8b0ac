"""From how far around a capture shows its subject."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tron.cameras import Camera
from tron.captures import LoadSettings, load_capture
from tron.captures.coverage import seen_from_deg

UP = np.array([0.0, 0.0, 1.0])


def cameras(azimuths: list[float], towards: float = -1.0) -> list[Camera]:
    found = []
    for azimuth, height in zip(np.radians(azimuths), np.linspace(0.2, 1.5, len(azimuths))):
        eye = np.array([2 * np.cos(azimuth), 2 * np.sin(azimuth), height])
        target = (0, 0, 0) if towards < 0 else 2 * eye
        found.append(Camera.look_at(eye, target, up=UP, fov_deg=40, width=16, height=16))
    return found


@pytest.mark.parametrize(
    ("azimuths", "around"),
    [([0, 90, 180, 270], 270), ([350, 10, 40], 50), (list(range(0, 360, 10)), 350), ([0, 180], 180)],
)
def test_it_is_all_but_the_widest_gap(azimuths: list[float], around: float) -> None:
    assert seen_from_deg(cameras(azimuths), UP) == pytest.approx(around, abs=1.0)


def test_it_does_not_depend_on_the_world() -> None:
    turn = np.linalg.qr(np.array([[0.3, 1, 0.2], [-1, 0.1, 0.5], [0.4, 0.2, 1]]))[0]
    turned = []
    for camera in cameras([0, 60, 130]):
        pose = np.eye(4)
        pose[:3, :3] = turn.T
        pose[:3, 3] = -turn.T @ (3, -7, 5)
        turned.append(replace(camera, world_to_camera=camera.world_to_camera @ pose))
    assert seen_from_deg(turned, turn @ UP) == pytest.approx(130, abs=1.0)


def test_cameras_that_look_outwards_show_no_thing() -> None:
    assert seen_from_deg(cameras([0, 90, 180, 270], towards=1.0), UP) is None


def test_photos_of_one_side_are_told_of(
    tmp_path: Path, photos, write, caplog: pytest.LogCaptureFixture
) -> None:
    """The arc of these photos is 2.3 radians."""
    write.photos(tmp_path / "images", photos)
    write.json(tmp_path / "transforms.json", write.transforms(photos))
    load_capture(tmp_path, LoadSettings(up=(0, 0, 1)))
    assert "from 132 degrees around" in caplog.text
