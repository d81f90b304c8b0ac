"""Camera paths: distance, aim and coverage hold for any target and any up direction."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from tron import trajectories
from tron.cameras import Camera
from tron.errors import TronError

PATHS = [trajectories.spiral, trajectories.oscillating, trajectories.orbit, trajectories.still]
VIEW = {"width": 32, "height": 24, "fov_deg": 40.0}
TARGET = np.array([1.0, -2.0, 0.5])


def elevations_deg(path: list[Camera], up: tuple = (0, 0, 1)) -> np.ndarray:
    outward = np.array([camera.position - TARGET for camera in path])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return np.degrees(np.arcsin(outward @ (np.asarray(up) / np.linalg.norm(up))))


def azimuths_deg(path: list[Camera]) -> np.ndarray:
    outward = np.array([camera.position - TARGET for camera in path])
    return np.degrees(np.unwrap(np.arctan2(outward[:, 1], outward[:, 0])))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0.3, -2.0, 0.5)])
@pytest.mark.parametrize("make", PATHS)
def test_every_camera_keeps_its_distance_and_sees_the_target_upright(make, up: tuple):
    path = make(17, target=TARGET, radius=3.0, up=up, **VIEW)
    assert len(path) == 17
    for camera in path:
        assert np.linalg.norm(camera.position - TARGET) == pytest.approx(3)
        np.testing.assert_allclose(camera.project(TARGET[None])[0], [[16, 12]], atol=1e-9)
        above = camera.project(np.array([TARGET + 0.1 * np.asarray(up) / np.linalg.norm(up)]))[0][0]
        assert above[0] == pytest.approx(16)
        assert above[1] < 12


def test_spiral_goes_from_low_to_high_in_the_stated_turns():
    path = trajectories.spiral(
        290, target=TARGET, radius=3, elevation_deg=(10, 75), turns=3, phase=20, **VIEW
    )
    elevation, azimuth = elevations_deg(path), azimuths_deg(path)
    assert elevation[[0, -1]] == pytest.approx([10, 75])
    assert (np.diff(elevation) > 0).all()
    assert azimuth[0] == pytest.approx(20)
    assert azimuth[-1] - azimuth[0] == pytest.approx(3 * 360)


def test_spiral_is_even_over_the_area_of_the_sphere():
    """Archimedes: equal bands of height are equal areas, so they hold equally many cameras."""
    path = trajectories.spiral(600, target=TARGET, radius=1, elevation_deg=(-60, 80), **VIEW)
    height = np.sin(np.radians(elevations_deg(path)))
    counts, _ = np.histogram(height, bins=6)
    assert np.ptp(counts) <= 2


def test_still_is_where_an_orbit_starts_one_object_for_all_frames():
    path = trajectories.still(5, target=TARGET, radius=2, phase=30, **VIEW)
    start = trajectories.orbit(7, target=TARGET, radius=2, phase=30, **VIEW)[0]
    assert len(path) == 5
    assert all(camera is path[0] for camera in path)
    np.testing.assert_array_equal(path[0].world_to_camera, start.world_to_camera)


def test_oscillation_swings_about_its_mean_between_its_azimuths():
    path = trajectories.oscillating(93, target=TARGET, radius=3, **VIEW)
    elevation, azimuth = elevations_deg(path), azimuths_deg(path)
    assert azimuth[[0, -1]] == pytest.approx([17, 338])
    assert elevation[0] == pytest.approx(28)
    assert elevation.max() == pytest.approx(42, abs=0.1)
    assert elevation.min() == pytest.approx(14, abs=0.1)


def test_orbit_is_level_counter_clockwise_and_closes():
    path = trajectories.orbit(12, target=TARGET, radius=2, elevation_deg=30, phase=45, **VIEW)
    azimuth = azimuths_deg(path)
    assert elevations_deg(path) == pytest.approx(30)
    assert np.diff(azimuth) == pytest.approx(30)
    assert azimuth[0] == pytest.approx(45)


def test_keyframes_are_met_and_the_way_between_is_shortest():
    a, b, c = trajectories.orbit(4, target=TARGET, radius=3, **VIEW)[:3]
    path = trajectories.keyframed([a, b, c], 9)
    for frame, key in ((0, a), (4, b), (8, c)):
        np.testing.assert_allclose(path[frame].world_to_camera, key.world_to_camera, atol=1e-9)
    turned = [
        np.degrees(np.arccos((np.trace(p.world_to_camera[:3, :3] @ q.camera_to_world[:3, :3]) - 1) / 2))
        for p, q in pairwise(path[:5])
    ]
    whole = np.degrees(np.arccos((np.trace(a.world_to_camera[:3, :3] @ b.camera_to_world[:3, :3]) - 1) / 2))
    assert turned == pytest.approx([whole / 4] * 4)  # constant speed along one great arc
    np.testing.assert_allclose(path[2].position, (a.position + b.position) / 2, atol=1e-9)


def test_keyframed_intrinsics_zoom_evenly():
    a = Camera.look_at((0, -3, 0), (0, 0, 0), **VIEW)
    b = Camera.look_at((0, -3, 0), (0, 0, 0), **{**VIEW, "fov_deg": 20.0})
    assert trajectories.keyframed([a, b], 3)[1].fx == pytest.approx((a.fx + b.fx) / 2)


def test_a_path_of_one_camera_is_its_start():
    for make in PATHS:
        first = make(1, target=TARGET, radius=3, **VIEW)[0]
        np.testing.assert_allclose(first.position, make(5, target=TARGET, radius=3, **VIEW)[0].position)
    assert len(trajectories.keyframed([first], 3)) == 3


@pytest.mark.parametrize(
    "change, complaint",
    [({"radius": 0}, "radius"), ({"elevation_deg": 90}, "elevation"), ({"up": (0, 0, 0)}, "up direction")],
)
def test_impossible_paths_are_refused(change: dict, complaint: str):
    settings: dict[str, Any] = {"target": TARGET, "radius": 1, **VIEW, **change}
    with pytest.raises(TronError, match=complaint):
        trajectories.orbit(4, **settings)


def test_empty_paths_and_mixed_sizes_are_refused():
    with pytest.raises(TronError, match="at least one"):
        trajectories.orbit(0, target=TARGET, radius=1, **VIEW)
    with pytest.raises(TronError, match="at least one"):
        trajectories.keyframed([], 3)
    camera = Camera.look_at((0, -3, 0), (0, 0, 0), **VIEW)
    with pytest.raises(TronError, match="one image size"):
        trajectories.keyframed([camera, camera.resized(8, 8)], 3)
