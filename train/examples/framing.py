"""Resize frames to a stage's size: downsample them until they just cover it, then crop.

An output pixel is the mean over the input area that it covers, with partly covered pixels weighted by their
share, as a camera with larger pixels would see it. Constant pictures stay constant and a frame's mean light
is kept. Means are taken in linear light, before tone mapping; display-encoded frames are decoded by the sRGB
curve first and encoded again. Width and height shrink by the same factor, up to rounding to whole pixels.
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
"""Windows start at multiples of this many pixels, which keeps the codec's blocks aligned."""


def channels_first(frames: np.ndarray) -> np.ndarray:
    """(K, H, W, C) -> (C, K, H, W) float32."""
    return np.ascontiguousarray(np.moveaxis(frames, -1, 0), np.float32)


@dataclass(frozen=True)
class Sample:
    """Frames of one clip.

    Attributes:
        buffers: (3, K, H, W) by name: linear with the clip's exposure applied, or display-encoded in [0, 1].
        display: names of the display-encoded buffers.
        stands_in: whether it replaces a damaged sample.
    """

    buffers: dict[str, Tensor]
    display: frozenset[str] = frozenset()
    stands_in: bool = False

    @classmethod
    def of(cls, clip: Clip) -> Sample:
        """Make a sample of all frames and members that were read of a clip."""
        buffers = {name: torch.from_numpy(channels_first(clip.exposed(name))) for name in clip.frames}
        return cls(buffers, frozenset(name for name in buffers if clip.is_display(name)))


def covering_size(frame: Size, size: Size) -> Size:
    """Smallest size with a frame's aspect that covers another; TronError if the frame is smaller."""
    if frame[0] < size[0] or frame[1] < size[1]:
        raise TronError(
            f"frames of {frame[0]} x {frame[1]} are smaller than the stage's size, {size[0]} x {size[1]}",
            mend="give the stage a smaller size: frames are never enlarged",
        )
    if size[0] * frame[1] >= size[1] * frame[0]:
        return size[0], max(size[1], round(frame[1] * size[0] / frame[0]))
    return max(size[0], round(frame[0] * size[1] / frame[1])), size[1]


def area_resized(video: Tensor, size: Size) -> Tensor:
    """Downsample (..., H, W) by area means; a tensor that has the size already is returned itself."""
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
    """Downsample frames (3, K, H, W) of one buffer until they just cover a size."""
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
    """Random start of a crop of `crop` out of `side` pixels, a multiple of ALIGNMENT."""
    return int(random.integers((side - crop) // ALIGNMENT + 1)) * ALIGNMENT


def sized(sample: Sample, size: Size | None, random: np.random.Generator) -> Sample:
    """Downsample a sample to just cover a size, then crop a random window of it, the same in all buffers.

    Args:
        size: width and height; None returns the sample as it is and draws no random number.

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
    """Downsample a clip to just cover a size, then crop the window at its centre; TronError as `sized`."""
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
