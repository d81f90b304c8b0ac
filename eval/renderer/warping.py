"""Warping error: how much a clip flickers, by exact flow.

Lai et al. 2018, *Learning Blind Video Temporal Consistency*, eq. 10: each frame is compared with the frame
before it, warped by the flow from it, and squared differences are averaged over pixels that both frames see.
Here the flow is that of the true surfaces and cameras (:mod:`tron.flow`), moved objects included, so that the
error is the pictures' own. It is not zero for the truth: reflections move otherwise than the surface that
shows them, lights that turn move shadows, path tracing is noisy, and interpolation blurs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tron.cameras import Camera
from tron.errors import TronError
from tron.flow import surface_motion, warp
from tron.shards.moving import Moving
from tron.shards.schema import Clip

DEPTH = "depth_ref"
"""Member that the flow needs, with the foreground."""


class Step(NamedTuple):
    """From one frame of a clip to that before it.

    Attributes:
        displacement: (H, W, 2) pixels, x then y, from each pixel to its surface's place in the frame before.
        judged: (H, W) bool, foreground whose surface both frames see.
    """

    displacement: np.ndarray
    judged: np.ndarray


class Flicker(NamedTuple):
    """Squared differences, summed, and the pixels that they are of."""

    squared: float
    pixels: int

    @property
    def mean(self) -> float:
        """Mean square, 0 where no pixel was judged."""
        return self.squared / self.pixels if self.pixels else 0.0


def steps(clip: Clip) -> list[Step]:
    """The K - 1 steps of a clip with true depth.

    Raises:
        TronError: the clip holds no true depth, or does not say how its object moves.
    """
    if DEPTH not in clip.frames:
        raise TronError(
            f"clip {clip.meta.key} has no {DEPTH}", mend="make the split with reference_buffers=true"
        )
    cameras = [Camera.from_dict(each) for each in clip.meta.cameras]
    depths, moving = clip.frames[DEPTH][..., 0], Moving.of(clip.meta)
    foreground = clip.frames["foreground"][..., 0] > 0.5
    match = surface_motion(cameras, depths.__getitem__, None if moving is None else moving.between)
    found = []
    for k in range(1, clip.meta.frames):
        displacement, seen = match(k, k - 1)
        found.append(Step(displacement, seen & foreground[k]))
    return found


def flicker(frames: np.ndarray, moves: list[Step]) -> Flicker:
    """Squared differences of each frame and that before it, warped, over the pixels that are judged.

    Args:
        frames: (K, H, W, 3) display values.
        moves: the K - 1 steps between them.
    """
    squared, pixels = 0.0, 0
    for before, now, move in zip(frames, frames[1:], moves):
        warped = warp(before, move.displacement)
        judged = move.judged & np.isfinite(warped).all(-1)
        squared += float(((now[judged] - warped[judged]) ** 2).mean(-1).sum())
        pixels += int(judged.sum())
    return Flicker(squared, pixels)
