"""Choice of ``checkpoint=auto``: the way with the largest gain on validation scenes, by size and quality.

GAINS are foreground PSNR less that of ``lit`` on procedural scenes that neither trained nor judge a network:
lower ends of the intervals over scenes (95 % of six at 128, the worst of four and two at 256 and 512), for
a gain that is not sure is none. ``tron-eval benchmark=renderer benchmark.parts=[validation]`` measures them
anew; whoever ships another checkpoint writes its own here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Literal

import numpy as np

Quality = Literal["preview", "final"]
Way = str
""":data:`NETWORK`, or the name of a denoiser (:mod:`tron.denoising`); a third way is ``lit`` as it is."""
NETWORK: Way = "network"
"""Name of the way that draws with the shipped network."""

GAINS: Mapping[Way, Mapping[Quality, Mapping[int, float]]] = {
    NETWORK: {
        "preview": {128: 0.73, 256: 0.54, 512: 0.36},
        "final": {128: 0.17, 256: 0.39, 512: 0.43},
    },
    "oidn": {
        "preview": {128: 0.15, 256: 0.02, 512: 0.03},
        "final": {128: 0.16, 256: 0.18, 512: 0.15},
    },
}
"""Way -> quality -> width of square frames, pixels -> gain in dB. Figures of 512 are from two scenes."""


def quality_of(supersample: int, reflections: int) -> Quality:
    """Return the quality of a frame: final if it has sub-pixels or reflection rays, else preview."""
    return "final" if supersample > 1 or reflections > 0 else "preview"


def expected_gain(way: Way, quality: Quality, width: int, height: int) -> float:
    """Return the least gain of a way over lit, dB, interpolated in the logarithm of the frame's side.

    The side is that of a square of as many pixels. Beyond the sizes that were measured the nearest holds.
    """
    known = GAINS[way][quality]
    side = math.log2(math.sqrt(width * height))
    return float(np.interp(side, [math.log2(each) for each in known], list(known.values())))


def best_first(ways: Iterable[Way], quality: Quality, width: int, height: int) -> dict[Way, float]:
    """Return ways with known gain -> least gain, dB; the largest gain comes first."""
    gains = {way: expected_gain(way, quality, width, height) for way in ways if way in GAINS}
    return dict(sorted(gains.items(), key=lambda each: -each[1]))
