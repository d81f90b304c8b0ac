"""Numbers of frames that a renderer takes, and the passes over a long clip. Loads no torch."""

from __future__ import annotations

from collections.abc import Sequence

from tron.errors import TronError

TEMPORAL_FACTOR = 4
"""Frames of a latent frame after the first, which holds one, of every codec there is."""


def check_frames(frames: int, temporal_factor: int = TEMPORAL_FACTOR) -> None:
    """TronError unless a clip has 1 + temporal_factor * n frames: a codec would silently drop the rest."""
    if frames < 1 or (frames - 1) % temporal_factor:
        counts = ", ".join(str(1 + temporal_factor * n) for n in range(3))
        mend = f"give {counts}, ... frames (1 + {temporal_factor}n)"
        raise TronError(f"a window has {frames} frames", mend=mend)


def windows(frames: int, size: int, temporal_factor: int = TEMPORAL_FACTOR) -> list[Sequence[int]]:
    """Frame indices of each pass over a clip: the first `size` frames, then a window for each new frame.

    Stride 1, as the paper has it; a clip shorter than the window is cut into the largest windows that fit.
    """
    size = min(size, frames - (frames - 1) % temporal_factor)
    return [range(start, start + size) for start in range(frames - size + 1)]
