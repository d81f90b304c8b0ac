"""Two scales of one network: low frequencies come from the picture drawn at half its size.

A network that learnt noise and blur of a few pixels meets blur that is twice as wide: at half the size it is
what was learnt.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from tron.estimation import MOST_RAYS, OCTAVES


def halved(buffers: Mapping[str, Tensor]) -> list[Tensor]:
    """Halve guidance by name, (B, 3, K, H, W) in [-1, 1], by means of 2 x 2 display values.

    An odd side's last pixel counts twice. ``sampling`` says how the larger pixels were sampled.
    """
    halves = {name: _mean(video) for name, video in buffers.items()}
    if "sampling" in halves:
        halves["sampling"] = of_wider_pixels(halves["sampling"], 2, least=-1)
    return list(halves.values())


def of_wider_pixels(sampling: Tensor, times: float, least: float = 0.0) -> Tensor:
    """Return ``sampling`` (..., 3, K, H, W) for means of ``times`` x ``times`` pixels: more rays, wider.

    What lies partly beyond the surfels is off by a part of that.

    Args:
        least: value of black, where white is 1.
    """
    octaves = math.log2(times)
    more = torch.tensor([0.0, 2 * octaves / MOST_RAYS, octaves / (OCTAVES[1] - OCTAVES[0])])
    return (sampling + (1 - least) * more.to(sampling)[:, None, None, None]).clamp(max=1)


def with_coarse(fine: Tensor, coarse: Tensor) -> Tensor:
    """Add to a picture (B, C, K, H, W), enlarged bilinearly, ``coarse`` minus the picture's 2 x 2 means."""
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
