"""The photometric loss of Gaussian splatting: 0.8 L1 + 0.2 (1 - SSIM), in torch, on display values.

From "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (Kerbl et al. 2023).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

SSIM_WEIGHT = 0.2
_WINDOW = 11


def photometric_loss(
    predicted: Tensor, target: Tensor, mask: Tensor | None = None, ssim_weight: float = SSIM_WEIGHT
) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) of two images, a scalar; differentiable in ``predicted``.

    Args:
        predicted, target: (H, W, 3) display values.
        mask: (H, W) bool, the pixels that count; elsewhere the prediction is taken to be right, so that
            SSIM's window, which reaches over the mask's edge, meets no foreign contrast there.
        ssim_weight: w. Images smaller than SSIM's half window (6 pixels) are compared by L1 alone.
    """
    if mask is None:
        mask = torch.ones(predicted.shape[:2], dtype=torch.bool, device=predicted.device)
    predicted = torch.where(mask[..., None], predicted, target)
    count = mask.sum().clamp(min=1)
    loss = (predicted - target).abs().sum() / (3 * count)
    if ssim_weight == 0 or min(predicted.shape[:2]) <= _WINDOW // 2:
        return loss
    first, second = (image.movedim(-1, 0)[None] for image in (predicted, target))
    result = structural_similarity_index_measure(first, second, data_range=1.0, return_full_image=True)
    similarity = (result[1][0].mean(0) * mask).sum() / count
    return (1 - ssim_weight) * loss + ssim_weight * (1 - similarity)
