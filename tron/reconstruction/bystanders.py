"""Passers-by: patches that stand in one photo and that the other photos contradict.

After "RobustNeRF: Ignoring Distractors with Robust Losses" (Sabour et al. 2023), which leaves out, view by
view, the pixels that are explained worst, smoothed because people are larger than pixels. There a fixed share
is left out, so that scenes without anybody lose detail; here only what stands out from what is usual over all
photos is:
patches whose mean error is several times the usual 90th percentile.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

_PATCHES = 16
"""Patches along the longer side of a photo."""
_PERCENTILE = 0.9
_MEMORY = 0.95
_MOST = 0.25
"""A view of which more stands out is not learnt yet; it is no crowd."""


class Bystanders:
    """Pixels of a stage's photos that are not learnt from.

    Args:
        ratio: errors of patches are left out beyond so many times the usual 90th percentile.
        begin: step from which they are: before, nothing is explained well.
    """

    def __init__(self, ratio: float, begin: int) -> None:
        self.ratio, self.begin = ratio, begin
        self._usual = float("nan")

    def without(
        self, step: int, picture: Tensor, wanted: Tensor, target: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """The view's maps with ``valid`` false where somebody stands.

        Args:
            step: steps done.
            picture: (H, W, 3) of the surfels, display values.
            wanted: (H, W, 3) that the view asks for.
            target: the view's maps.
        """
        error = (picture.detach() - wanted).abs().mean(-1)
        valid = target.get("valid")
        if valid is not None:
            error = torch.where(valid, error, 0)
        patches = _patch_means(error)
        now = float(torch.quantile(patches.flatten()[:: max(1, patches.numel() // 4096)], _PERCENTILE))
        self._usual = now if self._usual != self._usual else _MEMORY * self._usual + (1 - _MEMORY) * now
        if step < self.begin:
            return dict(target)
        stands = patches > self.ratio * self._usual
        if not 0 < float(stands.float().mean()) < _MOST:
            return dict(target)
        return {**target, "valid": ~stands if valid is None else valid & ~stands}

    def state(self) -> dict[str, Tensor]:
        """Tensors for a checkpoint."""
        return {"bystanders": torch.tensor(self._usual, dtype=torch.float64)}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Take up the state of a checkpoint."""
        self._usual = float(tensors["bystanders"])


def _patch_means(error: Tensor) -> Tensor:
    """(H, W) mean over the patch around each pixel, of a sixteenth of the longer side."""
    side = max(error.shape) // _PATCHES | 1
    return torch.nn.functional.avg_pool2d(
        error[None, None], side, stride=1, padding=side // 2, count_include_pad=False
    )[0, 0]
