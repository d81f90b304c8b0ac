"""A sample: frames of one clip under its exposure, before augmentation and AgX."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tron.shards.schema import Clip


def channels_first(frames: np.ndarray) -> np.ndarray:
    """(K, H, W, C) -> (C, K, H, W) float32."""
    return np.ascontiguousarray(np.moveaxis(frames, -1, 0), np.float32)


@dataclass(frozen=True)
class Sample:
    """Frames of one clip.

    Attributes:
        buffers: (3, K, H, W) by name: linear under the clip's exposure, or in [0, 1] where display-encoded.
        display: names of the display-encoded ones.
        stands_in: whether it is there in the place of a damaged one.
    """

    buffers: dict[str, Tensor]
    display: frozenset[str] = frozenset()
    stands_in: bool = False

    @classmethod
    def of(cls, clip: Clip) -> Sample:
        """All frames of a clip, in the members that it was read with."""
        buffers = {name: torch.from_numpy(channels_first(clip.exposed(name))) for name in clip.frames}
        return cls(buffers, frozenset(name for name in buffers if clip.is_display(name)))
