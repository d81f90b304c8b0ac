"""Motion between frames of a clip: objects are followed, depths read once."""

import numpy as np
import pytest

from tron.cameras import Camera
from tron.errors import TronError
from tron.flow import surface_motion
from tron.shards.moving import Moving

SIZE, DISTANCE = 48, 4.0
CAMERAS = [
    Camera.look_at((0.13 * k, 0, 0), (0.13 * k, 1, 0), fov_deg=50, width=SIZE, height=SIZE) for k in range(3)
]


def wall(camera: Camera) -> np.ndarray:
    """Distance of the plane y = DISTANCE along the rays."""
    return DISTANCE / camera.exact_rays()[..., 1]


def test_a_moved_object_is_followed():
    """A wall that is the moving object, shifted a pixel a frame to the right, seen by one standing camera."""
    camera = CAMERAS[0]
    step = DISTANCE / camera.fx
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 0, 3] = step * np.arange(3)
    moving = Moving(poses, np.ones((3, SIZE, SIZE), bool))
    motion = surface_motion([camera] * 3, lambda _: wall(camera), moving.between)
    np.testing.assert_allclose(motion(0, 2).displacement[..., 0], 2, atol=1e-6)
    np.testing.assert_allclose(motion(0, 2).displacement[..., 1], 0, atol=1e-6)
    still = surface_motion([camera] * 3, lambda _: wall(camera))
    np.testing.assert_allclose(still(0, 2).displacement, 0, atol=1e-9)


def test_depths_are_read_once_for_frames_near_each_other():
    read = []

    def depth(k: int) -> np.ndarray:
        read.append(k)
        return wall(CAMERAS[k])

    motion = surface_motion(CAMERAS, depth)
    motion(1, 2)
    motion(2, 1)
    assert sorted(read) == [1, 2]


def test_a_depth_of_another_size_is_refused():
    with pytest.raises(TronError, match="its camera has 48 x 48"):
        surface_motion(CAMERAS, lambda _: np.ones((4, 4)))(0, 1)


def test_a_sky_that_turns_is_never_seen_again():
    half = wall(CAMERAS[0])
    half[: SIZE // 2] = 0
    still = surface_motion([CAMERAS[0]] * 2, lambda _: half)(0, 1).seen
    turning = surface_motion([CAMERAS[0]] * 2, lambda _: half, still_sky=False)(0, 1).seen
    assert still[: SIZE // 2 - 1].all()
    assert not turning[: SIZE // 2].any()
    np.testing.assert_array_equal(still[SIZE // 2 :], turning[SIZE // 2 :])
    assert turning[SIZE // 2 + 1 :].all()
