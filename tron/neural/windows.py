"""Numbers of frames that a renderer takes, and the passes over a long clip. Loads no torch.

A window of K frames slides over the clip with stride 1, so that most frames lie in K windows. Which of those
draws a frame is the choice of the overlap:

    newest  the window that ends with it, as a live renderer would; the first window draws all its frames
    anchor  the window in whose middle it stands, with frames before it and after it; at the ends the nearest
    mean    all of them: their mean
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

from tron.errors import TronError

TEMPORAL_FACTOR = 4
"""Frames of a latent frame after the first, which holds one, of the codecs that compress time."""

Overlap = Literal["newest", "mean", "anchor"]


class Window(NamedTuple):
    """One pass: frames of the clip that go through the network, and those of them that are kept."""

    frames: range
    kept: range


def check_frames(frames: int, temporal_factor: int = TEMPORAL_FACTOR) -> None:
    """TronError unless a clip has 1 + temporal_factor * n frames: a codec would silently drop the rest."""
    if frames < 1 or (frames - 1) % temporal_factor:
        counts = ", ".join(str(1 + temporal_factor * n) for n in range(3))
        mend = f"give {counts}, ... frames (1 + {temporal_factor}n)"
        raise TronError(f"a window has {frames} frames", mend=mend)


def windows(
    frames: int, size: int, temporal_factor: int = TEMPORAL_FACTOR, overlap: Overlap = "anchor"
) -> list[Window]:
    """Passes over a clip, in order; every frame is kept at least once, and once but for the mean.

    Stride 1, as the paper has it; a clip shorter than the window is cut into the largest windows that fit.
    Raises TronError for another overlap.
    """
    if overlap not in get_args(Overlap):
        raise TronError(f"no overlap is called {overlap!r}", mend=f"they are {', '.join(get_args(Overlap))}")
    size = min(size, frames - (frames - 1) % temporal_factor)
    last = frames - size
    before = {"newest": size - 1, "anchor": (size - 1) // 2, "mean": 0}[overlap]
    passes = []
    for start in range(last + 1):
        covered = range(start, start + size)
        first, end = start + before, start + before + 1
        if overlap == "mean":
            first, end = covered.start, covered.stop
        # The ends of the clip stand in no window as they would have to.
        kept = range(0 if start == 0 else first, frames if start == last else end)
        passes.append(Window(covered, kept))
    return passes
