"""Small filters over the pixels of a video: one Gaussian for all, or a kernel of its own for each pixel.

Guidance is sampled once in a pixel, a photograph is a mean over it: whatever starts from a buffer of guidance
does well to filter it first. Kernels that a network predicts are those of Bako et al., "Kernel-Predicting
Convolutional Networks for Denoising Monte Carlo Renderings" (2017), sec. 4.1: a softmax over the neighbours.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad


def gaussian_logits(deviation: float, side: int) -> Tensor:
    """Logarithms of a Gaussian's weights at the centres of ``side`` x ``side`` pixels: (side^2,).

    Args:
        deviation: in pixels, above 0.
        side: odd; rows first.
    """
    steps = torch.arange(side) - side // 2
    squares = steps[:, None] ** 2 + steps**2
    return (-squares / (2 * deviation**2)).flatten()


def filtered(video: Tensor, weights: Tensor) -> Tensor:
    """Weighted sum of each pixel's neighbours; beyond the border the edge goes on.

    Args:
        video: (B, C, K, H, W).
        weights: of the neighbours, rows first: (side^2,), or (B, side^2, K, H, W) for kernels of their own.

    Returns:
        (B, C, K, H, W).
    """
    count = weights.shape[0] if weights.ndim == 1 else weights.shape[1]
    side = round(count**0.5)
    reach, (height, width) = side // 2, video.shape[-2:]
    wide = pad(video, (reach, reach, reach, reach, 0, 0), mode="replicate")
    result = torch.zeros_like(video)
    for k in range(count):
        y, x = divmod(k, side)
        weight = weights[k] if weights.ndim == 1 else weights[:, k : k + 1]
        result = result + weight * wide[..., y : y + height, x : x + width]
    return result
