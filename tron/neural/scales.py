"""Two scales of one network: what is coarse is taken from the picture drawn at half its size.

A network that learnt noise and blur of a few pixels meets blur that is twice as wide: at half the size it is
what was learnt.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from tron.estimation import of_wider_pixels


def halved(buffers: Mapping[str, Tensor]) -> list[Tensor]:
    """Guidance by name, (B, 3, K, H, W) in [-1, 1], at half its size: means of 2 x 2 pixels.

    An odd side's last pixel counts twice. ``sampling`` says how the larger pixels were sampled, where
    surfels are.
    """
    return [_told(video) if name == "sampling" else _mean(video) for name, video in buffers.items()]


def with_coarse(fine: Tensor, coarse: Tensor) -> Tensor:
    """A picture (B, C, K, H, W) whose means of 2 x 2 pixels are moved to those of ``coarse``."""
    height, width = fine.shape[-2:]
    frames = (coarse - _mean(fine)).transpose(1, 2).flatten(0, 1)
    wide = interpolate(frames, scale_factor=2, mode="bilinear", align_corners=False)[..., :height, :width]
    return fine + wide.unflatten(0, (-1, fine.shape[2])).transpose(1, 2)


def _mean(video: Tensor) -> Tensor:
    height, width = video.shape[-2:]
    frames = video.transpose(1, 2).flatten(0, 1)
    if height % 2 or width % 2:
        frames = pad(frames, (0, width % 2, 0, height % 2), mode="replicate")
    return avg_pool2d(frames, 2).unflatten(0, (-1, video.shape[2])).transpose(1, 2)


def _told(sampling: Tensor) -> Tensor:
    mean = _mean(sampling)
    more = 2 * torch.tensor(of_wider_pixels(2), dtype=mean.dtype, device=mean.device)  # [-1, 1] is 2 wide
    return torch.where(mean > -1, (mean + more[:, None, None, None]).clamp(max=1), mean)
