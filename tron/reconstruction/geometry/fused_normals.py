"""Fused normals of the surfels' own depths, which shape surfaces in stage 1 if no prior gives normals.

At regular intervals the median depths of all training views are rendered and fused
(:mod:`tron.tracing.fusion`), and each view reads the normals of the fused surface. Until the next fusion, the
surfels' normals are pulled to them by 2DGS's normal consistency (Huang et al. 2024, equation 14)

    mean over pixels of sum_i w_i (1 - n_i . N) = opacity - (sum_i w_i n_i) . N,

with N fixed; 2DGS takes N from the depth of the single view, which is noisy until depth is right.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from tron.captures import View
from tron.gaussians.fields import FIELDS, PARAMETERS
from tron.reconstruction.geometry.surfels import LearntSurfels
from tron.reconstruction.settings import ConsistencySettings
from tron.tracing.fusion import DepthMap, empty_rays, fused_views
from tron.tracing.torch_bridge import render

_SURFACE = 0.5
_GEOMETRY = ("means", "quats", "log_scales", "opacity_logits")
_STATE = "fused."


def normal_consistency(rendered: Mapping[str, Tensor], fused: Tensor) -> Tensor:
    """Mean over the pixels whose normal is known of opacity - (sum of w n) . N, a scalar.

    Args:
        rendered: images of :func:`tron.tracing.torch_bridge.render`.
        fused: (H, W, 3) unit normals, world, or zero where the views do not agree.
    """
    known = (fused * fused).sum(-1) > 0.25
    apart = rendered["opacity"] - (rendered["normal_sum"] * fused).sum(-1)
    return (apart * known).sum() / known.sum().clamp(min=1)


class FusedNormals:
    """The fused normals of the training views, recomputed as the surfels change.

    They are a function of the surfels' geometry at the last fusion, so a checkpoint stores that geometry.

    Args:
        settings: how often, how fine.
        kernel_degree: of the surfels.
    """

    def __init__(self, settings: ConsistencySettings, kernel_degree: int) -> None:
        self.settings, self.kernel_degree = settings, kernel_degree
        self._normals: dict[str, Tensor] = {}
        self._made_from: dict[str, Tensor] = {}

    def make(self, surfels: LearntSurfels, views: Sequence[View]) -> None:
        """Recompute them at the views' size."""
        self._make({name: surfels[name].detach().clone() for name in _GEOMETRY}, views)

    def of(self, view: View) -> dict[str, Tensor]:
        """``fused_normal``, (H, W, 3) float32 unit, world, zero where unknown; empty where there is none."""
        normals = self._normals.get(view.name)
        return {} if normals is None else {"fused_normal": normals.float()}

    def state(self) -> dict[str, Tensor]:
        """The geometry that was fused, for a checkpoint."""
        return {f"{_STATE}{name}": values for name, values in self._made_from.items()}

    def restore(self, stored: Mapping[str, Tensor], device: torch.device, views: Sequence[View]) -> None:
        """Inverse of :meth:`state`, in the views' size; before the first step there is none."""
        if _STATE + _GEOMETRY[0] not in stored:
            return
        self._make({name: stored[_STATE + name].to(device) for name in _GEOMETRY}, views)

    @torch.no_grad()
    def _make(self, tensors: Mapping[str, Tensor], views: Sequence[View]) -> None:
        self._made_from = dict(tensors)
        maps = [self._depth_map(view) for view in views]
        # Half precision is a hundredth of a degree, and half the memory of many large views.
        how = self.settings
        fused = fused_views(maps, how.truncation, how.sigma, how.most_voxels)
        device = tensors[_GEOMETRY[0]].device
        self._normals = {
            view.name: torch.from_numpy(normal).half().to(device) for view, (_, normal) in zip(views, fused)
        }

    def _depth_map(self, view: View) -> DepthMap:
        seen = render(
            _without_radiance(self._made_from), view.camera, kernel_degree=self.kernel_degree, sh_degree=0
        )
        depth = seen["depth"].cpu().numpy()
        empty = empty_rays(view.read("mask") > _SURFACE) if view.has("mask") else None
        return DepthMap(view.camera, depth, depth > 0, empty)


def _without_radiance(geometry: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The surfels as the renderer takes them, all black."""
    count = len(geometry["means"])
    black = {
        name: geometry["means"].new_zeros((count, *FIELDS[name].shape))
        for name in PARAMETERS
        if name not in geometry
    }
    return {**geometry, **black}
