"""Motion of a clip that is judged: by the depth of its surfels and its own cameras, where they are known."""

from collections.abc import Callable

import numpy as np
import pytest

from eval.relighting.buffers import Buffers
from tron.cameras import Camera
from tron.flow import flow
from tron.shards.schema import Clip


def test_motion_is_by_the_depth_of_the_surfels(drawn_clip: Callable[..., Clip]):
    clip = drawn_clip(frames=3)
    clip.frames["depth"] = clip.frames["depth_ref"] * np.float32(1.25)  # not the truth's
    motion = Buffers.of(clip).motion
    assert motion is not None
    cameras = [Camera.from_dict(each) for each in clip.meta.cameras]
    expected = flow(clip.frames["depth"][2], cameras[2], cameras[0])
    np.testing.assert_array_equal(motion(2, 0)[0], expected)
    assert motion(2, 0) is motion(2, 0), "methods that ask again wait for nothing"


def test_there_is_none_without_depth(drawn_clip: Callable[..., Clip]):
    clip = drawn_clip(frames=2)
    assert Buffers.of(clip).motion is not None
    del clip.frames["depth"]
    assert Buffers.of(clip).motion is None


@pytest.mark.parametrize(("turn", "seen"), [(0.0, True), (20.0, False)])
def test_under_a_light_that_turns_the_sky_is_not_seen_again(
    drawn_clip: Callable[..., Clip], turn: float, seen: bool
):
    clip = drawn_clip(frames=2)
    clip.frames["depth"][:] = 0
    clip.meta.cameras[1] = clip.meta.cameras[0]
    clip.meta.extra["turn_deg"] = turn
    motion = Buffers.of(clip).motion
    assert motion is not None
    assert motion(1, 0)[1][1:-1, 1:-1].all() == seen
    assert motion(1, 0)[1].any() == seen
