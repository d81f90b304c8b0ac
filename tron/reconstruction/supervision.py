"""Loss of stages 1 and 2: how far the surfels are from what a view shows.

Both stages compare with the same loss, (1 - w) L1 + w (1 - SSIM); they differ in which maps are compared and
in which parameters may answer. Colours are composited over a background, the photo's by its mask, the
surfels' by their opacity. Normals are compared as they come, faded by opacity, so that a wanted normal also
asks for a surface; materials only where there is one, because their geometry is frozen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tron.captures import View
from tron.gaussians.fields import MATERIALS
from tron.reconstruction.consistency import normal_consistency
from tron.reconstruction.losses import SSIM_WEIGHT, photometric_loss

_COMPARED = ("image", "normal", *MATERIALS)
_SURFACE = 0.5


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
        """The maps of a view that count, the mask and what is to be believed always among them."""
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
        target: the view's maps (see :func:`targets`), and ``fused_normal`` (see :mod:`.consistency`).
        weights: what counts.
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
    """Normals as colours, (n + 1) / 2; pixels whose normal nobody knows do not count."""
    wanted = target["normal"]
    known = (wanted * wanted).sum(-1) > 0.25
    if "mask" in target:  # beside the subject is no surface, whatever a prior sees there
        outside = target["mask"] < _SURFACE
        wanted, known = torch.where(outside[..., None], 0, wanted), known | outside
    if "valid" in target:
        known = known & target["valid"]
    normal = rendered["normal"] * rendered["opacity"][..., None]
    return photometric_loss(0.5 * normal + 0.5, 0.5 * wanted + 0.5, known, ssim)
