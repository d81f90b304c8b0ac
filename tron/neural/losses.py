"""The loss of training: errors of display values, PSNR, lost sharpness, LPIPS if there are weights."""

from __future__ import annotations

import logging
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from tron.metrics import LPIPS

log = logging.getLogger(__name__)

WINDOW = 16
"""Side of the windows in which sharpness is compared, pixels."""
KEPT = 0.9
"""Share of the target's root mean squared gradient that is asked for: the target has noise of its own."""


class RendererLoss:
    """l2 * mean squared error + lpips * LPIPS (VGG) - psnr * PSNR + sharpness * lost sharpness.

    On values in [-1, 1] (paper: 1, 1, 0, 0).

    PSNR is in dB, of each frame by itself (Chen et al., "Simple Baselines for Image Restoration", 2022): a
    frame that is nearly right counts as much as one that is far off, where the mean squared error hears the
    latter alone. A mean square is added that keeps it below ``psnr_ceiling``: a frame that is right by itself
    would have all say otherwise. Lost sharpness is :func:`lost_sharpness`.

    Without `vgg_weights` (torchvision's vgg16-397923af.pth) the LPIPS term is absent, and the log says so:
    a random VGG is never used silently. LPIPS is no module here, so that its frozen weights stay out of
    checkpoints and EMA. Raises TronError where the weights file is missing or is not VGG-16.
    """

    def __init__(
        self,
        l2: float = 1.0,
        lpips: float = 1.0,
        vgg_weights: str | Path | None = None,
        psnr: float = 0.0,
        sharpness: float = 0.0,
        psnr_ceiling: float = 50.0,
    ):
        self.l2, self.lpips, self.psnr, self.sharpness = l2, lpips, psnr, sharpness
        self.floor = 10 ** (-psnr_ceiling / 10)
        self.perceptual = LPIPS.load(vgg_weights) if vgg_weights is not None and lpips > 0 else None
        if self.perceptual is None:
            log.info("Loss: %s. LPIPS is absent: loss.vgg_weights names no VGG-16 file.", self._terms())
        else:
            log.info("Loss: %s + %g LPIPS (VGG)", self._terms(), lpips)

    def _terms(self) -> str:
        more = f" - {self.psnr:g} PSNR" if self.psnr else ""
        return f"{self.l2:g} L2{more}" + (f" + {self.sharpness:g} sharpness" if self.sharpness else "")

    def __call__(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Loss (scalar) of (B, 3, K, H, W) in [-1, 1]; the prediction is not clamped."""
        squares = (predicted - target).square()
        loss = self.l2 * squares.mean()
        if self.psnr:
            loss = loss + self.psnr * torch.log10(squares.mean((1, 3, 4)) / 4 + self.floor).mean() * 10
        if self.sharpness:
            loss = loss + self.sharpness * lost_sharpness(predicted, target)
        if self.perceptual is not None:
            frames = (video.transpose(1, 2).flatten(0, 1) for video in (predicted, target))
            loss = loss + self.lpips * self.perceptual(*frames).mean()
        return loss


def lost_sharpness(predicted: Tensor, target: Tensor) -> Tensor:
    """Return by how much a picture's gradients are weaker than KEPT times the target's, a mean (scalar).

    The strength is the root mean square of neighbours' differences over windows of WINDOW x WINDOW pixels,
    all channels. Whatever minimises an error of values is blurred where it does not know the detail (Blau and
    Michaeli, "The Perception-Distortion Tradeoff", 2018); this asks for the detail's strength alone, and the
    error of values for its place. Gradients that are too strong cost nothing here.

    Args:
        predicted, target: (B, C, K, H, W), H and W at least 2.
    """
    own, true = (_strength(video) for video in (predicted, target))
    return (KEPT * true - own).relu().mean()


def _strength(video: Tensor) -> Tensor:
    """Root mean square of neighbours' differences in each window: (B K, 1, h, w)."""
    frames = video.transpose(1, 2).flatten(0, 1)
    squares = frames.diff(dim=-1)[..., 1:, :].square() + frames.diff(dim=-2)[..., 1:].square()
    mean = avg_pool2d(squares.mean(1, keepdim=True), WINDOW, ceil_mode=True)
    return (mean + 1e-6).sqrt()  # its gradient is finite at 0


def psnr_per_frame(predicted: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the PSNR in dB per frame, (B, K), of (B, 3, K, H, W) in [-1, 1] as display values in [0, 1].

    The prediction is clamped; mask (B, 1, K, H, W) selects pixels, and a frame without any gives NaN.
    """
    error = ((predicted.clamp(-1, 1) - target) / 2).square()
    if mask is None:
        mean = error.mean((1, 3, 4))
    else:
        mean = (error * mask).sum((1, 3, 4)) / (3 * mask.sum((1, 3, 4)))
    return -10 * torch.log10(mean)
