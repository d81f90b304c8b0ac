"""The surfels being learnt: torch tensors, their Adam, and surgery that keeps the two in step.

Adam keeps two moments a number, so a surfel that is removed takes its moments along and one that is added
begins with none ("3D Gaussian Splatting", Kerbl et al. 2023). Harmonics are two tensors, because the constant
one has a rate of its own.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from tron.errors import TronError
from tron.gaussians.fields import FIELDS, MATERIALS, PARAMETERS
from tron.gaussians.harmonics import SH_COUNT
from tron.gaussians.scene import GaussianScene, measure_spacing
from tron.runtime import torch_device

ADAM_EPSILON = 1e-15
HARMONICS = {"sh_dc": (1, 3), "sh_rest": (SH_COUNT - 1, 3)}
SAME = tuple(name for name in PARAMETERS if name != "sh")
ROWS: dict[str, tuple[int, ...]] = {name: FIELDS[name].shape for name in SAME} | HARMONICS
"""Tensors by name and the shape of a row; as in :class:`GaussianScene`, but for the harmonics."""
_UNIT_WITHIN = 1e-6


class LearntSurfels:
    """M surfels under optimisation.

    Args:
        tensors: (M, ...) float32 by the names of :data:`ROWS`.
        rates: Adam's rate of the tensors that are learnt; the others stand still and cost nothing.

    Raises:
        TronError: there are no surfels.
    """

    def __init__(self, tensors: Mapping[str, Tensor], rates: Mapping[str, float]) -> None:
        self.rates = dict(rates)
        self.tensors: dict[str, Tensor] = {}
        for name in ROWS:
            self.tensors[name] = tensors[name].detach().clone().contiguous()
            self.tensors[name].requires_grad_(name in self.rates)
        if not len(self):
            raise TronError("there are no surfels to optimise")
        groups = [{"params": [self.tensors[name]], "lr": rate, "name": name} for name, rate in rates.items()]
        # The fused implementation updates in one pass over memory: a tenth of the time of the default one.
        self._adam = torch.optim.Adam(groups, eps=ADAM_EPSILON, fused=True)

    @staticmethod
    def of_scene(scene: GaussianScene, rates: Mapping[str, float]) -> LearntSurfels:
        """The surfels of a scene, on the device of the active variant."""
        arrays = {name: torch.tensor(getattr(scene, name)) for name in PARAMETERS}
        arrays["sh_dc"], arrays["sh_rest"] = arrays["sh"][:, :1], arrays["sh"][:, 1:]
        return LearntSurfels({name: array.to(torch_device()) for name, array in arrays.items()}, rates)

    def __len__(self) -> int:
        return len(self.tensors["means"])

    def __getitem__(self, name: str) -> Tensor:
        return self.tensors[name]

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.tensors["means"].device

    def rendered(self) -> dict[str, Tensor]:
        """The tensors under the names and shapes that :func:`tron.tracing.torch_bridge.render` takes."""
        harmonics = torch.cat([self.tensors[name] for name in HARMONICS], dim=1)
        return {name: self.tensors[name] for name in SAME} | {"sh": harmonics}

    def step(self) -> None:
        """Update what has a gradient; materials are brought back into [0, 1]."""
        self._adam.step()
        with torch.no_grad():
            for name in MATERIALS:
                if name in self.rates:
                    self.tensors[name].clamp_(0, 1)

    def clear_gradients(self) -> None:
        """Forget the gradients."""
        self._adam.zero_grad()

    def set_rate(self, name: str, rate: float) -> None:
        """Change Adam's rate of one tensor."""
        for group in self._adam.param_groups:
            if group["name"] == name:
                group["lr"] = rate

    def select(self, kept: Tensor) -> None:
        """Keep the surfels of a mask (M,) or of indices, in that order, and their moments."""
        if not (kept.any() if kept.dtype == torch.bool else len(kept)):
            raise TronError("no surfel would be left", mend="check poses, masks and learning rates")
        self._rebuild({name: values[kept] for name, values in self.tensors.items()}, lambda m: m[kept])

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Add surfels, (N, ...) by the names of :data:`ROWS`, without moments."""
        added = len(rows["means"])

        def extended(moment: Tensor) -> Tensor:
            return torch.cat([moment, moment.new_zeros((added, *moment.shape[1:]))])

        self._rebuild(
            {
                name: torch.cat([values.detach(), rows[name].detach()])
                for name, values in self.tensors.items()
            },
            extended,
        )

    def replace(self, name: str, values: Tensor) -> None:
        """Overwrite one tensor and clear its moments."""
        with torch.no_grad():
            self.tensors[name].copy_(values)
        state = self._adam.state.get(self.tensors[name])
        if state:
            state["exp_avg"].zero_()
            state["exp_avg_sq"].zero_()

    def _rebuild(self, tensors: Mapping[str, Tensor], moments) -> None:
        for group in self._adam.param_groups:
            old = group["params"][0]
            new = tensors[group["name"]].detach().contiguous().requires_grad_(True)
            state = self._adam.state.pop(old, None)
            if state:
                state["exp_avg"] = moments(state["exp_avg"]).contiguous()
                state["exp_avg_sq"] = moments(state["exp_avg_sq"]).contiguous()
                self._adam.state[new] = state
            group["params"] = [new]
            self.tensors[group["name"]] = new
        for name in ROWS:
            if name not in self.rates:
                self.tensors[name] = tensors[name].detach().contiguous()

    def state(self) -> dict[str, Tensor]:
        """Everything that the next steps depend on, as flat names, for a checkpoint."""
        stored = {f"surfels.{name}": values.detach() for name, values in self.tensors.items()}
        for name in self.rates:
            for moment, values in self._adam.state.get(self.tensors[name], {}).items():
                stored[f"adam.{name}.{moment}"] = values
        return stored

    @staticmethod
    def of_state(stored: Mapping[str, Tensor], rates: Mapping[str, float]) -> LearntSurfels:
        """Inverse of :meth:`state`, on the device of the active variant."""
        device = torch_device()
        tensors = {name: stored[f"surfels.{name}"].to(device) for name in ROWS}
        surfels = LearntSurfels(tensors, rates)
        for name in rates:
            moments = {
                moment: stored[f"adam.{name}.{moment}"].clone()
                for moment in ("step", "exp_avg", "exp_avg_sq")
                if f"adam.{name}.{moment}" in stored
            }
            if moments:
                # The fused implementation counts its steps where the parameters are.
                on = {moment: values.to(device) for moment, values in moments.items()}
                surfels._adam.state[surfels.tensors[name]] = on
        return surfels

    def scene(self, kernel_degree: int, up: np.ndarray) -> GaussianScene:
        """The surfels at rest, with unit quaternions."""
        arrays = {name: values.detach().cpu().numpy() for name, values in self.rendered().items()}
        quats = arrays["quats"].astype(np.float64)
        lengths = np.linalg.norm(quats, axis=1, keepdims=True)
        # What is a unit quaternion already stays as it is, bit by bit, however often a scene is learnt from.
        lengths = np.where(np.abs(lengths - 1) < _UNIT_WITHIN, 1, lengths)
        arrays["quats"] = np.where(lengths > 0, quats / np.where(lengths > 0, lengths, 1), (1.0, 0, 0, 0))
        return GaussianScene(
            **arrays,
            object_id=np.zeros(len(self), np.int32),
            kernel_degree=kernel_degree,
            spacing=measure_spacing(arrays["means"]),
            up=up,
        )
