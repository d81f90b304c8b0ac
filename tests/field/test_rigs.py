"""Rigs of several cameras as Metashape exports them: a slave stands by its master."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from tron.captures import load_capture
from tron.seeds import generator

BASE = np.eye(4)
BASE[:3, :3] = Rotation.from_euler("yx", (30, -10), degrees=True).as_matrix()
BASE[:3, 3] = (0.4, -0.1, 0.2)
"""From the slave's axes to the master's."""


def text(matrix: np.ndarray) -> str:
    return " ".join(map(repr, map(float, matrix.ravel())))


def write(folder: Path, slave: str, aligned: int = 4) -> list[np.ndarray]:
    """Four moments of two cameras; the camera-to-world matrices of the masters."""
    rng = generator(0, "test", "rig")
    lens = "<f>20</f>"
    sensor = (
        '<resolution width="16" height="16"/><calibration type="frame" class="adjusted">'
        f'<resolution width="16" height="16"/>{lens}</calibration>'
    )
    poses, cameras = [], []
    for k in range(4):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.normal(size=3)
        poses.append(pose)
        given = f"<transform>{text(pose)}</transform>" if k < aligned else ""
        cameras.append(f'<camera id="{2 * k}" sensor_id="0" label="{k}_a">{given}</camera>')
        cameras.append(f'<camera id="{2 * k + 1}" sensor_id="1" master_id="{2 * k}" label="{k}_b"/>')
        for name in "ab":
            Image.new("RGB", (16, 16), (20 * k, 90, 120)).save(folder / f"{k}_{name}.jpg")
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0"?><document version="2.0.0"><chunk label="1"><sensors>'
        f'<sensor id="0" type="frame">{sensor}</sensor>'
        f'<sensor id="1" type="frame" master_id="0">{sensor}{slave}</sensor></sensors>'
        f"<cameras>{''.join(cameras)}</cameras></chunk></document>"
    )
    return poses


def in_rig(matrix: np.ndarray = BASE) -> str:
    return f"<rotation>{text(matrix[:3, :3])}</rotation><location>{text(matrix[:3, 3])}</location>"


def test_a_slave_stands_by_its_master(tmp_path: Path) -> None:
    poses = write(tmp_path, in_rig())
    found = {view.name: view.camera.camera_to_world for view in load_capture(tmp_path).views}
    assert len(found) == 8
    for k, pose in enumerate(poses):
        np.testing.assert_allclose(found[f"{k}_a"], pose, atol=1e-9)
        np.testing.assert_allclose(found[f"{k}_b"], pose @ BASE, atol=1e-9)


@pytest.mark.parametrize(
    ("slave", "aligned", "skipped", "why"),
    [
        (in_rig(), 3, 2, "the master of its rig is not aligned"),
        ("", 4, 4, "a slave of a rig whose sensor has no rotation and location"),
        ("<rotation>1 0 0</rotation><location>0 0 0</location>", 4, 4, "are not numbers"),
        (in_rig(np.diag([2.0, 1, 1, 1])), 4, 4, "rotation"),
    ],
)
def test_slaves_that_cannot_be_placed_are_counted(
    tmp_path: Path, slave: str, aligned: int, skipped: int, why: str
) -> None:
    write(tmp_path, slave, aligned)
    found = load_capture(tmp_path).skipped
    assert len(found) == skipped
    assert any(why in reason for reason in found.values()), found


def test_the_rig_of_the_field(shared_data: Path, tmp_path: Path) -> None:
    """Its photos are those of the georeferenced capture, whose poses about the origin are there too."""
    field = shared_data / "field"
    if not (field / "metashape-rig").is_dir():
        pytest.skip(f"{field} is absent")
    shutil.copytree(field / "georeferenced-capture" / "origin" / "sparse", tmp_path / "sparse")
    shutil.copytree(field / "georeferenced-capture" / "images", tmp_path / "images")
    found, truth = load_capture(field / "metashape-rig"), load_capture(tmp_path)
    assert (len(found.views), found.skipped) == (24, {})
    for view, true in zip(found.views, truth.views):
        assert np.abs(view.camera.camera_to_world - true.camera.camera_to_world).max() < 1e-9
