"""The loss of training: squared error of display values, and LPIPS if its weights are given."""

from __future__ import annotations

import logging
from pathlib import Path

import torch
from torch import Tensor

from tron.metrics import LPIPS

log = logging.getLogger(__name__)


class RendererLoss:
    """l2 * mean squared error + lpips * LPIPS (VGG), frame by frame, on values in [-1, 1] (paper: 1 and 1).

    Without `vgg_weights` (torchvision's vgg16-397923af.pth) the LPIPS term is absent, and the log says so:
    a random VGG is never used silently. LPIPS is no module here, so that its frozen weights stay out of
    checkpoints and EMA. Raises TronError where the weights file is missing or is not VGG-16.
    """

    def __init__(self, l2: float = 1.0, lpips: float = 1.0, vgg_weights: str | Path | None = None):
        self.l2, self.lpips = l2, lpips
        self.perceptual = LPIPS.load(vgg_weights) if vgg_weights is not None and lpips > 0 else None
        if self.perceptual is None:
            log.info("Loss: L2 alone. LPIPS is absent: loss.vgg_weights names no VGG-16 file.")
        else:
            log.info("Loss: %g L2 + %g LPIPS (VGG)", l2, lpips)

    def __call__(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Loss (scalar) of (B, 3, K, H, W) in [-1, 1]; the prediction is not clamped."""
        loss = self.l2 * (predicted - target).square().mean()
        if self.perceptual is not None:
            frames = (video.transpose(1, 2).flatten(0, 1) for video in (predicted, target))
            loss = loss + self.lpips * self.perceptual(*frames).mean()
        return loss


def psnr_per_frame(predicted: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """PSNR in dB of the display values in [0, 1] that (B, 3, K, H, W) in [-1, 1] stand for -> (B, K).

    The prediction is clamped; mask (B, 1, K, H, W) selects pixels, and a frame without any gives NaN.
    """
    error = ((predicted.clamp(-1, 1) - target) / 2).square()
    if mask is None:
        mean = error.mean((1, 3, 4))
    else:
        mean = (error * mask).sum((1, 3, 4)) / (3 * mask.sum((1, 3, 4)))
    return -10 * torch.log10(mean)
