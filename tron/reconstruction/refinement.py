"""Depth maps moved to where the photographs agree best: multi-view photometric consistency.

The idea of PGSR ("PGSR: Planar-based Gaussian Splatting", Chen et al. 2024), which adds the correlation of
warped patches to the loss; here the rendered depths themselves are moved before they are fused. Distances a
little before and behind a view's own are compared with the photographs beside it. The hypotheses keep the
shape of the rendered surface, so that the compared windows slant as it does, which planes of a sweep cannot.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tron.reconstruction.matching import Photograph, agreed_cost, refined_minimum, window_mean
from tron.reconstruction.settings import StereoSettings


def refined_depth(
    photographs: Sequence[Photograph],
    beside: Sequence[int],
    index: int,
    depth: Tensor,
    pixels: float,
    steps: int,
    settings: StereoSettings,
) -> Tensor:
    """(H, W) depth, moved where the photographs are sure of it and unchanged elsewhere.

    Args:
        photographs: of all views, of the size of the depth maps.
        beside: those to compare with.
        index: of the view.
        depth: (H, W) distances along the rays, world units; 0 where there is none.
        pixels: how far to look to either side, in widths of a pixel on the surface.
        steps: hypotheses to either side.
        settings: windows, and how alike they must be.
    """
    photograph = photographs[index]
    footprint = depth / photograph.camera.fx
    offsets = torch.linspace(-pixels, pixels, 2 * steps + 1, device=depth.device)
    distances = depth + offsets[:, None, None] * footprint
    others = [photographs[k] for k in beside]
    cost = window_mean(agreed_cost(photograph, others, distances, settings.radius, settings.best), 1)
    place, least = refined_minimum(cost)
    between = (cost.argmin(0) > 0) & (cost.argmin(0) < 2 * steps)
    sure = (depth > 0) & between & (least < 1 - settings.confident) & photograph.textured(settings.radius)
    moved = depth + (place / steps - 1) * pixels * footprint
    return torch.where(sure, moved, depth)
