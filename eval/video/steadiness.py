"""Temporal stability of a clip with known cameras and true depth: warping error, flicker, distant views.

All three compare pictures of one surface point, found by exact flow (:mod:`tron.flow`). None is zero for the
truth: reflections do not move with their surface, turning lights move shadows, path tracing is noisy, and
interpolation blurs. Read them beside the truth's own figures.

Frame differences without flow (VBench's temporal flickering) call a frozen picture perfect; these do not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tron.flow import Match, warp


class Step(NamedTuple):
    """Step from one frame of a clip to another.

    Attributes:
        frame: number of the first frame.
        other: number of the other frame.
        displacement: (H, W, 2) pixels, x then y, from each pixel to its surface's place in the other frame.
        judged: (H, W) bool, pixels to judge, with surfaces that both frames see.
    """

    frame: int
    other: int
    displacement: np.ndarray
    judged: np.ndarray


class Difference(NamedTuple):
    """Squared differences of display values, the mean of three channels, summed over ``pixels``."""

    squared: float
    pixels: int

    @property
    def mean(self) -> float:
        """Mean square, 0 if no pixel was judged."""
        return self.squared / self.pixels if self.pixels else 0.0


@dataclass(frozen=True)
class Surfaces:
    """Steps of a clip: to the previous frame, to the next frame, and to the frame half a clip away."""

    before: Sequence[Step]
    after: Sequence[Step]
    far: Sequence[Step]

    @classmethod
    def of(cls, match: Callable[[int, int], Match], inside: np.ndarray) -> Surfaces:
        """Compute the steps of a clip of K frames; ``match`` is from :func:`tron.flow.surface_motion`.

        Args:
            match: surfaces of one frame in another.
            inside: (K, H, W) bool, pixels to judge.
        """
        count = len(inside)
        half = count // 2
        return cls(
            steps(match, inside, ((k, k - 1) for k in range(1, count))),
            steps(match, inside, ((k, k + 1) for k in range(1, count - 1))),
            steps(match, inside, ((k, k - half) for k in range(half, count)) if half > 1 else ()),
        )


def steps(
    match: Callable[[int, int], Match], inside: np.ndarray, pairs: Iterable[tuple[int, int]]
) -> list[Step]:
    """Return a step for each (frame, other frame) of ``pairs``; arguments as in :meth:`Surfaces.of`."""
    found = []
    for frame, other in pairs:
        displacement, seen = match(frame, other)
        found.append(Step(frame, other, displacement, seen & inside[frame]))
    return found


def warping_error(frames: np.ndarray, moves: Iterable[Step]) -> Difference:
    """Return differences between each step's frame and the other frame warped to it.

    Lai et al. 2018, *Learning Blind Video Temporal Consistency*, eq. 10, with the flow of the true surfaces.
    For :attr:`Surfaces.before` it is the warping error; for :attr:`Surfaces.far` it shows whether distant
    views show one scene.

    Args:
        frames: (K, H, W, 3) display values.
        moves: between them.
    """
    return _summed(
        (frames[each.frame] - warp(frames[each.other], each.displacement), each.judged) for each in moves
    )


def flicker(frames: np.ndarray, surfaces: Surfaces) -> Difference:
    """Return the difference of each frame from the mean of its two neighbours, warped to it.

    It is the second difference along the surfaces: even changes, as under a turning light, cancel; changes of
    a single frame remain. White noise of variance s^2 gives 1.5 s^2.

    Args:
        frames: (K, H, W, 3) display values.
        surfaces: the steps between them.
    """
    after = {each.frame: each for each in surfaces.after}
    found = []
    for back in surfaces.before:
        if (on := after.get(back.frame)) is not None:
            sides = warp(frames[back.other], back.displacement) + warp(frames[on.other], on.displacement)
            found.append((frames[back.frame] - 0.5 * sides, back.judged & on.judged))
    return _summed(found)


@dataclass(frozen=True)
class Steadiness:
    """Figures of one clip by one method; RMS figures are in display values."""

    warping: Difference
    flicker: Difference
    far: Difference

    @classmethod
    def of(cls, frames: np.ndarray, surfaces: Surfaces) -> Steadiness:
        """Measure (K, H, W, 3) display values."""
        return cls(
            warping_error(frames, surfaces.before),
            flicker(frames, surfaces),
            warping_error(frames, surfaces.far),
        )


def _summed(found: Iterable[tuple[np.ndarray, np.ndarray]]) -> Difference:
    """Sum differences (H, W, 3) over judged and interpolated pixels (H, W)."""
    squared, pixels = 0.0, 0
    for difference, judged in found:
        kept = judged & np.isfinite(difference).all(-1)
        squared += float((difference[kept] ** 2).mean(-1).sum())
        pixels += int(kept.sum())
    return Difference(squared, pixels)
