"""Cameras from files: TRON's own, nerfstudio's, and those that are neither."""

import json

import numpy as np
import pytest

from tron.cameras import Camera
from tron.errors import TronError
from tron.scans.camera_files import read_cameras
from tron.trajectories import plan_cameras

VIEW = {"width": 64, "height": 48, "fov_deg": 50}


def test_cameras_come_back_from_a_file_at_any_size(ball_on_floor, tmp_path):
    cameras = plan_cameras(ball_on_floor(), "spiral", 3, **VIEW)
    entries = [camera.to_dict() for camera in cameras]
    for name, content in (("list.json", entries), ("object.json", {"cameras": entries, "frames": 3})):
        (tmp_path / name).write_text(json.dumps(content))
        back = read_cameras(tmp_path / name, 128, 96)
        assert [camera.width for camera in back] == [128] * 3
        np.testing.assert_allclose(back[1].world_to_camera, cameras[1].world_to_camera)
        assert back[1].fx == pytest.approx(2 * cameras[1].fx)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("not json", "not JSON"),
        ("[]", "no cameras"),
        ('{"cameras": 3}', "no cameras"),
        ('[{"fx": 1}]', "camera lacks"),
        ("[1, 2]", "no cameras"),
    ],
)
def test_broken_camera_files_are_refused(tmp_path, content, words):
    path = tmp_path / "cameras.json"
    path.write_text(content)
    with pytest.raises(TronError, match=words):
        read_cameras(path, 64, 48)


def test_another_aspect_ratio_and_a_missing_file_are_refused(ball_on_floor, tmp_path):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([c.to_dict() for c in plan_cameras(ball_on_floor(), "orbit", 1, **VIEW)]))
    with pytest.raises(TronError, match="64 x 48"):
        read_cameras(path, 64, 64)
    with pytest.raises(TronError, match="cannot read"):
        read_cameras(tmp_path / "absent.json", 64, 48)


def nerfstudio_path(camera: Camera, **changes) -> dict:
    """What nerfstudio's viewer saves: OpenGL camera-to-world, row-major, and the vertical field of view."""
    fov = np.degrees(2 * np.arctan(camera.height / 2 / camera.fy))
    # Columns right, up, back: written out here, not by tron.cameras.
    down, forward = camera.world_to_camera[1, :3], camera.world_to_camera[2, :3]
    columns = [camera.world_to_camera[0, :3], -down, -forward, camera.position]
    to_world = np.vstack([np.stack(columns, axis=1), [0, 0, 0, 1]])
    entry = {"camera_to_world": to_world.ravel().tolist(), "fov": fov, "aspect": 4 / 3}
    return {
        "camera_type": "perspective",
        "render_width": 1440,
        "render_height": 1080,
        "fps": 24,
        "camera_path": [entry],
    } | changes


def test_a_camera_path_of_nerfstudio_shows_the_same_view(tmp_path):
    camera = Camera.look_at((1, -2, 0.7), (0.1, 0.2, 0.3), fov_deg=50, width=64, height=48)
    (tmp_path / "camera_path.json").write_text(json.dumps(nerfstudio_path(camera)))
    (back,) = read_cameras(tmp_path / "camera_path.json", 64, 48)
    points = np.array([[0.1, 0.2, 0.3], [0.4, 0.1, 0], [0, 0.5, 0.9]])
    np.testing.assert_allclose(back.project(points)[0], camera.project(points)[0], atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"camera_type": "equirectangular"}, "is equirectangular"),
        ({"camera_path": []}, "no cameras"),
        ({"camera_path": [{"fov": 50}]}, "lacks 'camera_to_world'"),
        ({"camera_path": [{"camera_to_world": [1, 2], "fov": 50}]}, "unreadable"),
        ({"render_height": 1440}, "same aspect ratio"),
    ],
)
def test_a_camera_path_that_cannot_be_followed_is_refused(tmp_path, changes, words):
    camera = Camera.look_at((1, -2, 0.7), (0, 0, 0), fov_deg=50, width=64, height=48)
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(nerfstudio_path(camera, **changes)))
    with pytest.raises(TronError, match=words):
        read_cameras(path, 64, 48)
