"""Depth and normals that all views agree on: each view's rays walked to the zero of the fused field."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tron.reconstruction.fusion import DepthMap, DistanceField, fuse, pixel_footprint
from tron.reconstruction.settings import FusionSettings

_STEPS = 4
_STRIDE = 0.8
_CLOSE = 0.25  # of the reach: farther from zero no surface was met
_STEEP = 0.15  # of a full slope: flatter fields have no direction
_SEEN = 0.5


def fused_views(maps: Sequence[DepthMap], settings: FusionSettings) -> list[tuple[Tensor, Tensor]]:
    """The views' consensus on their own fused depths, as of :func:`consensus`; empty without a surface."""
    field = fuse(maps, pixel_footprint(maps), settings.truncation, settings.most_voxels)
    return [] if field is None else consensus(field, maps, settings.sigma)


def consensus(field: DistanceField, maps: Sequence[DepthMap], sigma: float) -> list[tuple[Tensor, Tensor]]:
    """Depth (H, W) and unit normal (H, W, 3), world, of each view; 0 where the views do not agree.

    Args:
        field: of the same maps.
        maps: a walk begins at a view's own depth.
        sigma: of the Gaussian that smooths the field, voxels.
    """
    smooth = field.smoothed(sigma)
    grids = torch.cat([smooth.value[None], smooth.gradient(), smooth.weight[None]])
    return [_walked(smooth, grids, each) for each in maps]


def _walked(field: DistanceField, grids: Tensor, view: DepthMap) -> tuple[Tensor, Tensor]:
    starts = view.depth > 0
    origin = view.depth.new_tensor(view.camera.position)
    every = view.rays
    rays, depth = every[starts], view.depth[starts]
    for _ in range(_STEPS):
        value = field.sample(grids[:1], origin + depth[:, None] * rays)[:, 0]
        depth = depth + _STRIDE * field.reach * value
    found = field.sample(grids, origin + depth[:, None] * rays)
    normal = found[:, 1:4]
    slope = normal.norm(dim=-1)
    normal = normal / slope.clamp(min=1e-9)[:, None]
    agreed = (found[:, 0].abs() < _CLOSE) & (slope * field.reach > _STEEP) & (found[:, 4] > _SEEN)
    agreed &= (normal * rays).sum(-1) < 0
    depths = torch.zeros_like(view.depth)
    normals = torch.zeros_like(every)
    depths[starts] = depth * agreed
    normals[starts] = normal * agreed[:, None]
    return depths, normals
