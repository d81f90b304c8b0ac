"""Which numbers of frames the codecs take, and how a long clip is cut into them. Loads no torch."""

from __future__ import annotations

from collections.abc import Sequence

from tron.errors import TronError

TIME = 4
"""Frames of a latent frame after the first, which holds one."""


def check_frames(frames: int) -> None:
    """TronError unless a clip has 1 + 4n frames: the codecs would silently drop the rest."""
    if frames < 1 or (frames - 1) % TIME:
        raise TronError(f"a window has {frames} frames", mend="give 1, 5, 9, ... frames (1 + 4n)")


def windows(frames: int, size: int) -> list[Sequence[int]]:
    """Frame indices of each pass over a clip: the first `size` frames, then a window for each new frame.

    Stride 1, as the paper has it; a clip shorter than the window is cut into the largest windows that fit.
    """
    size = min(size, frames - (frames - 1) % 4)
    return [range(start, start + size) for start in range(frames - size + 1)]
