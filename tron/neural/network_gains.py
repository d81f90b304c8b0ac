"""Where ``checkpoint=auto`` takes the network: where it gains on validation scenes, by size and quality.

GAINS are foreground PSNR of ``surfaces`` less that of ``lit`` on procedural scenes that neither trained nor
judge it: lower ends of the intervals over scenes (95 % of six at 128, the worst of four and three at 256 and
512), for a gain that is not sure is none. ``tron-eval
benchmark=renderer benchmark.parts=[validation]`` measures them anew; whoever ships another checkpoint writes
its own here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import numpy as np

Quality = Literal["preview", "final"]

GAINS: Mapping[Quality, Mapping[int, float]] = {
    "preview": {128: 0.83, 256: 0.60, 512: 0.55},
    "final": {128: 0.22, 256: 0.29, 512: 0.30},
}
"""Quality -> width of square frames, pixels -> dB. Those of 512 were measured on the material of before."""


def quality_of(supersample: int, reflections: int) -> Quality:
    """The one of the two that a frame is like: final where it has sub-pixels, or rays for reflections."""
    return "final" if supersample > 1 or reflections > 0 else "preview"


def expected_gain(quality: Quality, width: int, height: int) -> float:
    """What the network gains over lit at least, dB, between the sizes of GAINS by the logarithm of the side.

    The side is that of a square of as many pixels. Beyond the sizes that were measured the nearest holds.
    """
    known = GAINS[quality]
    side = math.log2(math.sqrt(width * height))
    return float(np.interp(side, [math.log2(each) for each in known], list(known.values())))
