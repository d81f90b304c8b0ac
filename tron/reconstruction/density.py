"""Adaptive density control: surfels are added where positions are pulled hard, removed where transparent.

From "3D Gaussian Splatting" (Kerbl et al. 2023), with the gradient of the 3D position that 3DGRT uses in
place of the screen's ("3D Gaussian Ray Tracing", Moenne-Loccoz et al. 2024): a surfel is cloned or split
where the mean of |d loss / d position| x distance to the camera / 2, over the steps that saw it, exceeds a
threshold.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tron.reconstruction.settings import DensitySettings
from tron.reconstruction.surfels import LearntSurfels
from tron.seeds import generator


class DensityControl:
    """Adds and removes surfels as training goes.

    Args:
        settings: when and how.
        extent: size of the capture, world units.
        seed: root of the splits' samples.
    """

    def __init__(self, settings: DensitySettings, extent: float, seed: int) -> None:
        self.settings, self.extent, self.seed = settings, extent, seed
        self.total = self.seen = torch.zeros(0)

    def observe(self, surfels: LearntSurfels, camera: Tensor) -> None:
        """Take note of the gradients of one step, seen from ``camera``, (3,), world."""
        if len(self.total) != len(surfels):
            self.forget(surfels)
        means = surfels["means"]
        if means.grad is None:
            return
        pull = means.grad.norm(dim=1)
        self.total += pull * (means.detach() - camera).norm(dim=1) / 2
        self.seen += pull > 0

    def forget(self, surfels: LearntSurfels) -> None:
        """Begin a new mean."""
        self.total = torch.zeros(len(surfels), device=surfels.device)
        self.seen = torch.zeros(len(surfels), device=surfels.device)

    def after(self, surfels: LearntSurfels, step: int) -> None:
        """Add, remove and reset surfels as is due once ``step`` (from 1) is done."""
        s = self.settings
        if s.start < step < s.end and step % s.every == 0:
            self._add(surfels, step)
        if step % s.prune_every == 0 and step < s.end:
            self._prune(surfels)
        if s.reset_every and step < s.end and step % s.reset_every == 0:
            most = torch.logit(torch.tensor(s.reset_to, device=surfels.device))
            surfels.replace("opacity_logits", surfels["opacity_logits"].detach().clamp(max=most))

    def _prune(self, surfels: LearntSurfels) -> None:
        kept = torch.sigmoid(surfels["opacity_logits"].detach()) >= self.settings.prune_below
        if kept.all():
            return
        surfels.select(kept)
        if len(self.total) == len(kept):
            self.total, self.seen = self.total[kept], self.seen[kept]

    def _add(self, surfels: LearntSurfels, step: int) -> None:
        s = self.settings
        pull = self.total / self.seen.clamp(min=1)
        capacity = max(s.most - len(surfels), 0)
        chosen = torch.nonzero(pull > s.threshold)[:, 0]
        if len(chosen) > capacity:  # a clone and a split both add one
            chosen = chosen[torch.topk(pull[chosen], capacity, sorted=False).indices].sort().values
        if len(chosen):
            scale = surfels["log_scales"].detach()[chosen].exp().amax(dim=1)
            small = scale <= s.clone_below * self.extent
            clones = {name: values.detach()[chosen[small]] for name, values in surfels.tensors.items()}
            halves = self._halves(surfels, chosen[~small], step)
            kept = torch.ones(len(surfels), dtype=torch.bool, device=surfels.device)
            kept[chosen[~small]] = False
            added = {name: torch.cat([clones[name], halves[name]]) for name in clones}
            # Surfels are added before those that they replace go, so that there is always one.
            surfels.append(added)
            surfels.select(torch.cat([kept, kept.new_ones(len(added["means"]))]))
        self.forget(surfels)

    def _halves(self, surfels: LearntSurfels, chosen: Tensor, step: int) -> dict[str, Tensor]:
        """Two smaller surfels for each one chosen, at points drawn from it in its plane."""
        rows = {
            name: values.detach()[chosen].repeat_interleave(2, dim=0)
            for name, values in surfels.tensors.items()
        }
        draw = generator(self.seed, "density", "split", step).standard_normal((len(chosen) * 2, 2))
        place = torch.tensor(draw, dtype=torch.float32, device=surfels.device) * rows["log_scales"].exp()
        tangent_u, tangent_v = _tangents(rows["quats"])
        rows["means"] = rows["means"] + place[:, :1] * tangent_u + place[:, 1:] * tangent_v
        rows["log_scales"] = rows["log_scales"] - torch.log(torch.tensor(self.settings.split_shrink))
        return rows

    def state(self) -> dict[str, Tensor]:
        """The running means, for a checkpoint."""
        return {"density.total": self.total, "density.seen": self.seen}

    def restore(self, stored: dict[str, Tensor], device: torch.device) -> None:
        """Inverse of :meth:`state`."""
        self.total, self.seen = (stored[f"density.{name}"].to(device) for name in ("total", "seen"))


def _tangents(quats: Tensor) -> tuple[Tensor, Tensor]:
    """Tangents u and v, (M, 3) each, world, of quaternions (w, x, y, z) of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    u = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=1)
    v = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=1)
    return u, v
