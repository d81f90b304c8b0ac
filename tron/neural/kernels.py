"""Filters of a picture with a kernel for each pixel, Gaussian or predicted by a network.

Guidance is sampled once in a pixel, a photograph is a mean over it: whatever starts from a buffer of guidance
does well to filter it first. Kernels that a network predicts are those of Bako et al., "Kernel-Predicting
Convolutional Networks for Denoising Monte Carlo Renderings" (2017), sec. 4.1: a softmax over the neighbours.
"""

from __future__ import annotations

from typing import Any

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


def filtered(video: Tensor, weights: Tensor, step: int = 1) -> Tensor:
    """Return the weighted sum of each pixel's neighbours; the border is replicated.

    Args:
        video: (B, C, K, H, W).
        weights: of the neighbours, rows first: (side^2,), or (B, side^2, K, H, W) for kernels of their own.
        step: pixels from one neighbour to the next.

    Returns:
        (B, C, K, H, W).
    """
    count = weights.shape[0] if weights.ndim == 1 else weights.shape[1]
    side = round(count**0.5)
    reach = side // 2 * step
    wide = pad(video, (reach, reach, reach, reach, 0, 0), mode="replicate")
    own = weights.reshape(1, -1, 1, 1, 1) if weights.ndim == 1 else weights
    return _Gathering.apply(wide, own, step)  # type: ignore[no-any-return]


class _Gathering(torch.autograd.Function):
    """Weighted sums without an intermediate for each neighbour, which autograd would keep and add up."""

    @staticmethod
    def forward(ctx: Any, wide: Tensor, weights: Tensor, step: int) -> Tensor:
        """``wide`` is padded; ``weights``: (B, side^2, K, H, W), of which sides of 1 stand for all."""
        ctx.save_for_backward(wide, weights)
        ctx.step = step
        shape = _inner(wide, weights, step)
        result = torch.zeros(shape, dtype=torch.result_type(wide, weights), device=wide.device)
        for k, window in _windows(wide, weights, step):
            result.addcmul_(window, weights[:, k : k + 1])
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:  # type: ignore[override]
        """Gradients of both, where they are wanted."""
        wide, weights = ctx.saved_tensors
        of_wide = torch.zeros_like(wide) if ctx.needs_input_grad[0] else None
        of_weights = torch.zeros_like(weights) if ctx.needs_input_grad[1] else None
        for k, window in _windows(wide, weights, ctx.step):
            if of_weights is not None:
                products = (gradient * window).sum(1, keepdim=True)
                of_weights[:, k : k + 1] = products.sum_to_size(of_weights[:, k : k + 1].shape)
        if of_wide is not None:
            for k, window in _windows(of_wide, weights, ctx.step):
                window.addcmul_(gradient, weights[:, k : k + 1])
        return of_wide, of_weights, None


def _inner(wide: Tensor, weights: Tensor, step: int) -> torch.Size:
    reach = 2 * (round(weights.shape[1] ** 0.5) // 2 * step)
    return torch.Size([*wide.shape[:-2], wide.shape[-2] - reach, wide.shape[-1] - reach])


def _windows(wide: Tensor, weights: Tensor, step: int) -> list[tuple[int, Tensor]]:
    """Number of each neighbour and the padded picture's part that shows it."""
    height, width = _inner(wide, weights, step)[-2:]
    side = round(weights.shape[1] ** 0.5)
    starts = [(k, *(step * c for c in divmod(k, side))) for k in range(weights.shape[1])]
    return [(k, wide[..., y : y + height, x : x + width]) for k, y, x in starts]
