"""Up is found from the cameras, however they look down, roll or lie on their side."""

import numpy as np
import pytest

from tron.cameras import Camera
from tron.captures.assembly import estimate_up
from tron.seeds import generator


def camera(position, target=(0, 0, 0), up=(0, 0, 1), roll_deg: float = 0.0) -> Camera:
    level = Camera.look_at(position, target, up=up, fov_deg=50, width=8, height=6)
    roll = np.eye(4)
    angle = np.radians(roll_deg)
    roll[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return Camera(level.fx, level.fy, 4, 3, 8, 6, roll @ level.world_to_camera)


def arc(degrees: float, elevation: float, count: int = 24, **options) -> list[Camera]:
    angles = np.radians(np.linspace(0, degrees, count, endpoint=False))
    return [camera((3 * np.cos(a), 3 * np.sin(a), elevation), **options) for a in angles]


def off(cameras: list[Camera], up=(0, 0, 1)) -> float:
    """Degrees between the estimate and the truth."""
    return float(np.degrees(np.arccos(np.clip(estimate_up(cameras) @ up, -1, 1))))


def test_level_cameras_all_around() -> None:
    assert off(arc(360, 1.0)) < 0.01


def test_looking_down_on_one_side_does_not_tilt_up() -> None:
    """The mean of the cameras' own up axes is 40 degrees off here."""
    cameras = arc(120, 3.0)
    mean = np.mean([each.up for each in cameras], axis=0)
    assert np.degrees(np.arccos(mean[2] / np.linalg.norm(mean))) > 30
    assert off(cameras) < 2


def test_parallel_cameras_take_the_mean() -> None:
    cameras = [camera((x, -3, 0), (x, 0, 0)) for x in np.linspace(-1, 1, 7)]
    assert off(cameras) < 0.01


def test_unsteady_hands() -> None:
    rng = generator(1, "roll")
    cameras = [
        camera(each.position + rng.normal(0, 0.1, 3), rng.normal(0, 0.3, 3), roll_deg=rng.normal(0, 4))
        for each in arc(360, 1.5, 40)
    ]
    assert off(cameras) < 3


def test_a_few_photos_held_sideways_do_not_count() -> None:
    cameras = arc(360, 1.0, 24)
    cameras[::6] = [camera(each.position, roll_deg=90) for each in cameras[::6]]
    assert off(cameras) < 2


@pytest.mark.parametrize("roll", [90, -90])
def test_photos_stored_on_their_side(roll: float) -> None:
    assert off(arc(360, 1.0, roll_deg=roll)) < 1


def test_a_drone_that_looks_straight_down() -> None:
    """Up axes point wherever the drone flies; positions lie in a plane, and it looks away from up."""
    rng = generator(1, "drone")
    cameras = []
    for heading in np.radians(np.arange(0, 360, 15)):
        x, y = rng.uniform(-3, 3, 2)
        cameras.append(camera((x, y, 5), (x, y, 0), up=(np.cos(heading), np.sin(heading), 0)))
    assert off(cameras) < 1


def test_up_turns_with_the_world() -> None:
    up = np.array([0.36, -0.48, 0.8])
    side = np.cross(up, (1.0, 0, 0))
    side /= np.linalg.norm(side)
    third = np.cross(up, side)
    positions = [3 * (np.cos(a) * side + np.sin(a) * third) + up for a in np.linspace(0, 5, 20)]
    assert off([camera(each, up=up) for each in positions], up) < 0.5


def test_two_cameras_are_enough() -> None:
    assert off([camera((3, 0, 0.5)), camera((0, 3, 0.5))]) < 2
