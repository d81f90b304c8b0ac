"""cameras.json says where a scene was filmed from, and an orbit stays between these cameras."""

import json
from pathlib import Path

import numpy as np
import pytest

from tron.apps.relight.settings import Settings
from tron.cameras import Camera, focus_of
from tron.captures import View
from tron.errors import TronError
from tron.scans.camera_files import CAMERAS, filmed_cameras, filmed_orbit, read_cameras, write_cameras

FRAMES = 40
IMAGE = {"width": 64, "height": 48, "fov_deg": 40.0}
UPS = [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)]


def level(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    east = np.cross(up, (0.3, 0.5, 0.7))
    east /= np.linalg.norm(east)
    return east, np.cross(up, east)


def around(azimuths, up, elevation=lambda turn: 20.0, radius=lambda turn: 3.0) -> list[Camera]:
    """Cameras that look at (1, 2, 3) from these azimuths, degrees."""
    up, focus = np.asarray(up), np.array([1.0, 2, 3])
    east, north = level(up)
    cameras = []
    for azimuth in azimuths:
        a, e = np.radians(azimuth), np.radians(elevation(azimuth))
        out = np.cos(e) * (np.cos(a) * east + np.sin(a) * north) + np.sin(e) * up
        cameras.append(Camera.look_at(focus + radius(azimuth) * out, focus, up=up, **IMAGE))
    return cameras


def polar(cameras: list[Camera], up) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Azimuth and elevation, degrees, and distance of cameras about (1, 2, 3)."""
    up = np.asarray(up)
    east, north = level(up)
    offsets = np.stack([camera.position for camera in cameras]) - (1, 2, 3)
    across = np.hypot(offsets @ east, offsets @ north)
    azimuth = np.degrees(np.arctan2(offsets @ north, offsets @ east))
    return azimuth, np.degrees(np.arctan2(offsets @ up, across)), np.linalg.norm(offsets, axis=1)


@pytest.mark.parametrize("up", UPS, ids=str)
def test_photos_from_one_side_are_filmed_from_that_side(up) -> None:
    filmed = around(np.linspace(-50, 35, 12), up)
    azimuth, elevation, distance = polar(filmed_orbit(filmed, FRAMES, up=np.array(up), **IMAGE), up)
    assert azimuth.min() == pytest.approx(-50, abs=0.1)
    assert azimuth.max() == pytest.approx(35, abs=2)
    assert elevation == pytest.approx(20, abs=0.01)
    assert distance == pytest.approx(3, abs=0.01)
    steps = np.diff(azimuth)
    assert (steps > 0).all()  # each place once
    assert steps.max() < 4


@pytest.mark.parametrize("up", UPS, ids=str)
def test_photos_from_all_sides_are_gone_around_at_their_heights_and_distances(up) -> None:
    filmed = around(
        np.arange(0, 360, 12),
        up,
        lambda a: 25 + 15 * np.sin(np.radians(a)),
        lambda a: 3 + np.cos(np.radians(a)),
    )
    orbit = filmed_orbit(filmed, FRAMES, up=np.array(up), **IMAGE)
    azimuth, elevation, distance = polar(orbit, up)
    turns = (np.diff(azimuth) + 180) % 360 - 180
    assert turns == pytest.approx(360 / FRAMES, abs=0.1)
    assert elevation == pytest.approx(25 + 15 * np.sin(np.radians(azimuth)), abs=3)
    assert distance == pytest.approx(3 + np.cos(np.radians(azimuth)), abs=0.2)
    for camera in orbit:
        toward = np.array([1.0, 2, 3]) - camera.position
        assert camera.forward @ toward / np.linalg.norm(toward) > np.cos(np.radians(3))
        assert abs(camera.camera_to_world[:3, 0] @ np.asarray(up)) < 1e-9  # level


def test_a_room_is_filmed_from_where_it_was_photographed() -> None:
    places = np.stack([np.linspace(0, 2, 9), 0.2 * np.sin(np.arange(9)), np.full(9, 1.5)], axis=1)
    turns = np.linspace(0, 2 * np.pi, 9)
    filmed = [
        Camera.look_at(place, place + np.array([np.cos(turn), np.sin(turn), 0]), up=(0, 0, 1), **IMAGE)
        for place, turn in zip(places, turns)
    ]
    assert focus_of([camera.camera_to_world for camera in filmed])[1]
    path = np.stack([c.position for c in filmed_orbit(filmed, FRAMES, up=np.array([0, 0, 1.0]), **IMAGE)])
    for place in path:
        on_walk = [np.interp(place[0], places[:, 0], places[:, axis]) for axis in range(3)]
        np.testing.assert_allclose(place, on_walk, atol=1e-6)


def test_distance_is_a_factor_on_that_to_what_is_looked_at() -> None:
    filmed = around(np.linspace(0, 90, 10), UPS[0])
    far = filmed_orbit(filmed, FRAMES, up=np.array(UPS[0]), distance=2.0, **IMAGE)
    assert polar(far, UPS[0])[2] == pytest.approx(6, abs=0.1)


def views(sizes: list[tuple[int, int]]) -> list[View]:
    cameras = around(np.arange(len(sizes)) * 20, UPS[0])
    found = []
    for index, (camera, (width, height)) in enumerate(zip(cameras, sizes)):
        one = Camera(70.0, 70.0, width / 2, height / 2, width, height, camera.world_to_camera)
        found.append(View(f"{index}", one, np.zeros((height, width, 3)), "display"))
    return found


def test_what_was_filmed_can_be_filmed_again(tmp_path: Path) -> None:
    stored = views([(64, 48)] * 3)
    write_cameras(tmp_path, stored)
    for camera, view in zip(read_cameras(tmp_path / CAMERAS, 64, 48), stored):
        assert camera.to_dict() == view.camera.to_dict()
    assert json.loads((tmp_path / CAMERAS).read_text())["names"] == ["0", "1", "2"]
    assert len(filmed_cameras(tmp_path / "scene.ply") or ()) == 3


def test_all_get_the_size_of_most_and_show_the_same_where_both_look(tmp_path: Path) -> None:
    stored = views([(64, 48), (48, 64), (64, 48)])
    write_cameras(tmp_path, stored)
    turned = read_cameras(tmp_path / CAMERAS, 64, 48)[1]
    point = np.array([[1.05, 2.1, 2.95]])
    before, after = stored[1].camera.project(point)[0], turned.project(point)[0]
    np.testing.assert_allclose(after - (32, 24), before - (24, 32), atol=1e-9)


def test_another_shape_is_refused_with_one_that_fits(tmp_path: Path) -> None:
    write_cameras(tmp_path, views([(48, 64)] * 2))
    with pytest.raises(TronError, match="such as width=384 height=512") as caught:
        read_cameras(tmp_path / CAMERAS, 512, 512)
    assert "\n" not in str(caught.value)


def test_no_file_is_no_filmed_space(tmp_path: Path) -> None:
    assert filmed_cameras(tmp_path / "scene.ply") is None


@pytest.mark.parametrize(
    ("given", "size", "fov"),
    [({}, (384, 512), True), ({"width": 96}, (96, 128), True), ({"height": 64}, (48, 64), True),
     ({"width": 100, "height": 50, "fov": 20.0}, (100, 50), False)],
)  # fmt: skip
def test_frames_have_the_shape_and_lens_of_the_photos(tmp_path: Path, given, size, fov) -> None:
    photos = views([(48, 64)] * 2)
    write_cameras(tmp_path, photos)
    files = {"scene": tmp_path / "scene.ply", "environment": "a.hdr", "output_dir": "out"}
    shaped = Settings.model_validate({**files, **given}).shaped()
    assert shaped.size == size
    assert shaped.fov == pytest.approx(photos[0].camera.fov_deg if fov else 20.0)


def test_without_photos_frames_are_square() -> None:
    files = {"scene": "nowhere/scene.ply", "environment": "a.hdr", "output_dir": "out"}
    shaped = Settings.model_validate(files).shaped()
    assert (shaped.size, shaped.fov) == ((512, 512), 40.0)
