"""Loss of stages 1 and 2: the difference between the surfels' maps and a view's.

Both stages use the same loss, (1 - w) L1 + w (1 - SSIM); they differ in the maps compared and the parameters
learnt. Colours are composited over a background, the photo's by its mask, the surfels' by their opacity.
Normals are compared with their weight by opacity, so that a target normal also pulls opacity up; materials
are compared only on surfaces, because their geometry is frozen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tron.captures import View
from tron.gaussians.fields import MATERIALS
from tron.reconstruction.geometry.fused_normals import normal_consistency

_COMPARED = ("image", "normal", *MATERIALS)
_SURFACE = 0.5
SSIM_WEIGHT = 0.2
_WINDOW = 11
_SIGMA = 1.5
_BLOCK = 32
_C1, _C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class Weights:
    """Weight of each map in the loss; maps that a view lacks count nothing."""

    rgb: float = 0.0
    normal: float = 0.0
    mask: float = 0.0
    base_color: float = 0.0
    roughness: float = 0.0
    metallic: float = 0.0
    ssim: float = SSIM_WEIGHT
    consistency: float = 0.0

    def wanted(self) -> tuple[str, ...]:
        """The maps of a view that count, always including ``mask`` and ``valid``."""
        names = [name for name in _COMPARED if getattr(self, "rgb" if name == "image" else name) > 0]
        return (*names, "mask", "valid")


def targets(view: View, wanted: tuple[str, ...], device: str | torch.device) -> dict[str, Tensor]:
    """Those of the wanted maps that the view has, (H, W[, 3]) float32; ``valid`` is bool.

    Images are display values.
    """
    found = {name: view.read(name) for name in wanted if view.has(name)}
    if "valid" in found:
        found["valid"] = view.believed()
    return {name: torch.from_numpy(values).to(device) for name, values in found.items()}


def loss_of(
    rendered: Mapping[str, Tensor], target: Mapping[str, Tensor], weights: Weights, background: np.ndarray
) -> Tensor:
    """The weighted loss of one view, a scalar.

    Args:
        rendered: images of :func:`tron.tracing.torch_bridge.render`.
        target: the view's maps (see :func:`targets`), and ``fused_normal`` (see :mod:`.fused_normals`).
        weights: of the maps.
        background: (3,) display colour behind the surfels.
    """
    opacity, mask, valid = rendered["opacity"], target.get("mask"), target.get("valid")
    total = opacity.new_zeros(())
    if weights.rgb and "image" in target:
        rgb, wanted = pictures(rendered, target, background)
        total = total + weights.rgb * photometric_loss(rgb, wanted, valid, weights.ssim)
    if weights.normal and "normal" in target:
        total = total + weights.normal * _normal_loss(rendered, target, weights.ssim)
    if weights.mask and mask is not None:
        total = total + weights.mask * (opacity - mask).abs().mean()
    if weights.consistency and "fused_normal" in target:
        total = total + weights.consistency * normal_consistency(rendered, target["fused_normal"])
    surface = opacity.detach() > _SURFACE
    if valid is not None:
        surface = surface & valid
    if mask is not None:
        surface = surface & (mask > _SURFACE)
    for name in MATERIALS:
        if getattr(weights, name) and name in target:
            loss = photometric_loss(rendered[name], target[name], surface, weights.ssim)
            total = total + getattr(weights, name) * loss
    return total


def pictures(
    rendered: Mapping[str, Tensor], target: Mapping[str, Tensor], background: np.ndarray
) -> tuple[Tensor, Tensor]:
    """The surfels' picture and the view's, (H, W, 3) each, over the same background (3,)."""
    rgb, wanted, mask = rendered["rgb"], target["image"], target.get("mask")
    behind = torch.tensor(background, dtype=torch.float32, device=rgb.device)
    if mask is not None:
        wanted = mask[..., None] * wanted + (1 - mask[..., None]) * behind
    if background.any():
        rgb = rgb + (1 - rendered["opacity"][..., None]) * behind
    return rgb, wanted


def _normal_loss(rendered: Mapping[str, Tensor], target: Mapping[str, Tensor], ssim: float) -> Tensor:
    """Loss of normals as colours, (n + 1) / 2; pixels with an unknown normal do not count."""
    wanted = target["normal"]
    known = (wanted * wanted).sum(-1) > 0.25
    if "mask" in target:  # beside the subject is no surface, whatever a prior sees there
        outside = target["mask"] < _SURFACE
        wanted, known = torch.where(outside[..., None], 0, wanted), known | outside
    if "valid" in target:
        known = known & target["valid"]
    normal = rendered["normal"] * rendered["opacity"][..., None]
    return photometric_loss(0.5 * normal + 0.5, 0.5 * wanted + 0.5, known, ssim)


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
