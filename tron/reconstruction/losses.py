"""The photometric loss of Gaussian splatting: 0.8 L1 + 0.2 (1 - SSIM), in torch, on display values.

From "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (Kerbl et al. 2023); SSIM from "Image
Quality Assessment" (Wang et al. 2004), with the Gaussian window of 11 pixels and sigma 1.5.

SSIM is written out here, although torchmetrics (which the tests compare it with, and reports use) has it: on
a processor its convolutions took a third of an optimisation step. A separable window is a product with two
band matrices, and the adjoint filters three maps instead of five; docs/experiments.md has the times.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from torch import Tensor

SSIM_WEIGHT = 0.2
_WINDOW = 11
_SIGMA = 1.5
_BLOCK = 32
_C1, _C2 = 0.01**2, 0.03**2


def photometric_loss(
    predicted: Tensor, target: Tensor, mask: Tensor | None = None, ssim_weight: float = SSIM_WEIGHT
) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) of two images, a scalar; differentiable in ``predicted``.

    Args:
        predicted: (H, W, 3) or (H, W) display values.
        target: likewise.
        mask: (H, W) bool, the pixels that count; elsewhere the prediction is taken to be right, so that
            SSIM's window, which reaches over the mask's edge, meets no foreign contrast there.
        ssim_weight: w. Images smaller than SSIM's half window (6 pixels) are compared by L1 alone.
    """
    if predicted.dim() == 2:
        predicted, target = predicted[..., None], target[..., None]
    height, width, channels = predicted.shape
    weight = torch.full((height, width), 1 / (height * width), device=predicted.device)
    if mask is not None:
        predicted = torch.where(mask[..., None], predicted, target)
        weight = mask / mask.sum().clamp(min=1)
    loss = ((predicted - target).abs().sum(-1) * weight).sum() / channels
    if ssim_weight == 0 or min(height, width) <= _WINDOW // 2:
        return loss
    # Not 1 - the mean: where the mask holds no pixel, nothing is wrong.
    difference = ((1 - structural_similarity(predicted, target).mean(-1)) * weight).sum()
    return (1 - ssim_weight) * loss + ssim_weight * difference


def structural_similarity(predicted: Tensor, target: Tensor) -> Tensor:
    """Structural similarity of each pixel and channel, (H, W, C), for values in [0, 1].

    Images are continued by reflection. Differentiable in ``predicted`` alone.
    """
    return _StructuralSimilarity.apply(predicted, target)  # pyright: ignore[reportReturnType]


class _StructuralSimilarity(torch.autograd.Function):
    """With window means m, variances v and covariance c of x and y, SSIM is

    (2 mx my + C1) (2 c + C2) / ((mx^2 + my^2 + C1) (vx + vy + C2)) = a b / (p q),

    which depends on x through the window sums of x, x^2 and x y.
    """

    @staticmethod
    def forward(ctx: Any, predicted: Tensor, target: Tensor) -> Tensor:
        x, y = predicted.detach().movedim(-1, 0), target.detach().movedim(-1, 0)
        rows, columns = _window(x.shape[1], x.device), _window(x.shape[2], x.device)
        mx, my, xx, yy, xy = _filtered(torch.stack([x, y, x * x, y * y, x * y]), rows, columns)
        a, p = 2 * mx * my + _C1, mx * mx + my * my + _C1
        b, q = 2 * (xy - mx * my) + _C2, xx - mx * mx + yy - my * my + _C2
        ctx.save_for_backward(x, y, mx, my, a, b, p, q)
        return (a * b / (p * q)).movedim(0, -1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        x, y, mx, my, a, b, p, q = ctx.saved_tensors
        outer = gradients[0].movedim(-1, 0) / (p * q)
        by_xy = 2 * a * outer
        ratio = b * outer / q
        by_xx = -a * ratio
        by_mx = 2 * my * (b - a) * outer - 2 * mx * (a * b * outer / p + by_xx)
        rows, columns = _window(x.shape[1], x.device), _window(x.shape[2], x.device)
        by_mx, by_xx, by_xy = _filtered(torch.stack([by_mx, by_xx, by_xy]), rows.T, columns.T)
        return (by_mx + 2 * x * by_xx + y * by_xy).movedim(0, -1), None


def _filtered(images: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """``rows @ images @ columns.T`` of band matrices, (..., H, W): block by block, for the rest is zero."""
    reach = _WINDOW - 1  # reflection at the border widens the band there
    parts = []
    for first in range(0, len(rows), _BLOCK):
        low, high = max(first - reach, 0), min(first + _BLOCK + reach, len(rows))
        parts.append(rows[first : first + _BLOCK, low:high] @ images[..., low:high, :])
    images = torch.cat(parts, dim=-2)
    parts = []
    for first in range(0, len(columns), _BLOCK):
        low, high = max(first - reach, 0), min(first + _BLOCK + reach, len(columns))
        parts.append(images[..., low:high] @ columns[first : first + _BLOCK, low:high].T)
    return torch.cat(parts, dim=-1)


@cache
def _window(size: int, device: torch.device) -> Tensor:
    """(size, size) band matrix that takes a row of pixels to its Gaussian window means."""
    reach = _WINDOW // 2
    offsets = torch.arange(-reach, reach + 1)
    weights = torch.exp(-0.5 * (offsets / _SIGMA) ** 2)
    columns = (torch.arange(size)[:, None] + offsets).abs()
    columns = torch.where(columns >= size, 2 * (size - 1) - columns, columns)
    matrix = torch.zeros(size, size)
    return matrix.scatter_add_(1, columns, (weights / weights.sum()).expand(size, -1).contiguous()).to(device)
