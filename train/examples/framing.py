"""Frames brought to a stage's size: made smaller until they just cover it, then cut.

An output pixel is the mean of the area of the input that it covers (fractions of pixels count by their
share), which is what a camera with larger pixels would have seen: constants stay, and so does the sum of the
light over a frame. Means are taken of linear light, before tone mapping; display-encoded frames are decoded
by the sRGB curve for it, and encoded again. Width and height shrink alike but for rounding to whole pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tron.color import linear_to_srgb, srgb_to_linear
from tron.errors import TronError
from tron.neural.scales import of_wider_pixels
from tron.shards.schema import MEMBERS, TARGET, Clip

Size = tuple[int, int]
"""Width and height, pixels."""
ALIGNMENT = 4
"""Windows start at multiples of this: it keeps the codec's blocks."""


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


def covering_size(frame: Size, size: Size) -> Size:
    """Smallest size with a frame's aspect that covers another; TronError where the frame itself does not."""
    if frame[0] < size[0] or frame[1] < size[1]:
        raise TronError(
            f"frames of {frame[0]} x {frame[1]} are smaller than the stage's size, {size[0]} x {size[1]}",
            mend="give the stage a smaller size: frames are never enlarged",
        )
    if size[0] * frame[1] >= size[1] * frame[0]:
        return size[0], max(size[1], round(frame[1] * size[0] / frame[0]))
    return max(size[0], round(frame[0] * size[1] / frame[1])), size[1]


def area_resized(video: Tensor, size: Size) -> Tensor:
    """(..., H, W) at most as large, every pixel the mean of its area; the same tensor if it has that size."""
    for axis, length in ((-1, size[0]), (-2, size[1])):
        if video.shape[axis] != length:
            video = _averaged(video, axis, length)
    return video


def _averaged(video: Tensor, axis: int, length: int) -> Tensor:
    before = video.shape[axis]
    step = before / length
    edges = np.arange(length + 1) * step
    total: Tensor | None = None
    for tap in range(math.ceil(step) + 1):
        index = np.floor(edges[:-1] + 1e-9).astype(np.int64) + tap
        share = np.minimum(index + 1, edges[1:]) - np.maximum(index, edges[:-1])
        weights = torch.from_numpy((np.clip(share, 0, None) / step).astype(np.float32))
        weights = weights if axis == -1 else weights[:, None]
        part = video.index_select(axis, torch.from_numpy(np.minimum(index, before - 1))) * weights
        total = part if total is None else total.add_(part)
    assert total is not None
    return total


def _covering(name: str, video: Tensor, size: Size, display: bool) -> Tensor:
    """Frames (3, K, H, W) of one buffer, as small as just covers a size."""
    height, width = video.shape[-2:]
    covering = covering_size((width, height), size)
    if covering == (width, height):
        return video
    if name == "sampling":
        return of_wider_pixels(area_resized(video, covering), width / covering[0])
    if display:
        return linear_to_srgb(area_resized(srgb_to_linear(video), covering)).clamp(0, 1)
    return area_resized(video, covering)


def _cut(video: Tensor, size: Size, corner: tuple[int, int]) -> Tensor:
    (left, top), (width, height) = corner, size
    return video[..., top : top + height, left : left + width]


def random_start(random: np.random.Generator, side: int, crop: int) -> int:
    """First of `crop` pixels out of `side`, a multiple of ALIGNMENT."""
    return int(random.integers((side - crop) // ALIGNMENT + 1)) * ALIGNMENT


def sized(sample: Sample, size: Size | None, random: np.random.Generator) -> Sample:
    """A sample whose frames cover a size, and a random window of that size out of them, alike in all buffers.

    Args:
        size: width and height; None leaves the sample as it is, and draws nothing.

    Raises:
        TronError: the frames are smaller than the size.
    """
    if size is None:
        return sample
    video = sample.buffers[TARGET]
    covering = covering_size((video.shape[-1], video.shape[-2]), size)
    corner = tuple(random_start(random, side, crop) for side, crop in zip(covering, size))
    return Sample(
        {
            name: _cut(_covering(name, video, size, name in sample.display), size, (corner[0], corner[1]))
            for name, video in sample.buffers.items()
        },
        sample.display,
    )


def centred(clip: Clip, size: Size | None) -> Clip:
    """A clip whose frames cover a size, and the window of that size at their centre; TronError as `sized`."""
    if size is None:
        return clip
    width, height = covering_size((clip.meta.width, clip.meta.height), size)
    corner = (width - size[0]) // 2, (height - size[1]) // 2

    def shown(name: str, frames: np.ndarray) -> np.ndarray:
        video = torch.from_numpy(np.moveaxis(frames, -1, 0))
        display = clip.is_display(name) and MEMBERS[name].color_space is not None
        return np.moveaxis(_cut(_covering(name, video, size, display), size, corner).numpy(), 0, -1)

    meta = clip.meta.model_copy(update={"width": size[0], "height": size[1]})
    return Clip(meta, {name: shown(name, frames) for name, frames in clip.frames.items()})
