"""Checkpoints of a reconstruction: everything that its next step depends on, in one safetensors file.

safetensors hold numbers and nothing that could run. A checkpoint replaces the one before it, whole or not at
all, so that a run that is killed loses the steps since the last one and no more.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from tron.claim import require_same
from tron.errors import TronError
from tron.reconstruction.surfels import LearntSurfels
from tron.reconstruction.training import Stage
from tron.storage import write_atomic

_FORMAT = "tron-reconstruction 2"


def save_checkpoint(
    path: Path,
    stage: Stage,
    made_with: Mapping[str, Any],
    seconds: float,
    begun: Mapping[str, Any] | None = None,
) -> None:
    """Write where a stage stands.

    Args:
        path: the file.
        stage: under way, between two steps.
        made_with: plain values that a run must share to go on from here.
        seconds: spent on the run so far.
        begun: plain values that tell how the first surfels were found.
    """
    tensors = stage.surfels.state()
    if stage.plan.density is not None:
        tensors |= stage.plan.density.state()
    for part in (stage.exposures, stage.bystanders):
        tensors |= part.state() if part is not None else {}
    if stage.fused is not None:
        tensors |= stage.fused.state()
    about = {
        **{"stage": stage.plan.name, "step": stage.step, "psnr": stage.psnr, "seconds": seconds},
        "begun": dict(begun or {}),
    }
    metadata = {
        "format": _FORMAT,
        "about": json.dumps(about),
        "made_with": json.dumps(made_with, sort_keys=True),
    }
    on_cpu = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_atomic(path, save(on_cpu, metadata))


class Checkpoint:
    """A checkpoint that was read.

    Raises:
        TronError: the file is unreadable or no such checkpoint.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                if metadata.get("format") != _FORMAT:
                    raise TronError("not a checkpoint of a reconstruction", path, "remove it to begin anew")
                about = json.loads(metadata["about"])
                self.made_with: dict[str, Any] = json.loads(metadata["made_with"])
                self.tensors: dict[str, Tensor] = {n: file.get_tensor(n) for n in file.keys()}  # noqa: SIM118 (no mapping)
        except (SafetensorError, OSError, KeyError, ValueError) as error:
            raise TronError(
                f"cannot read the checkpoint: {error}", path, "remove it to begin anew"
            ) from error
        self.stage: str = about["stage"]
        self.step: int = about["step"]
        self.psnr: float = about["psnr"]
        self.seconds: float = about["seconds"]
        self.begun: dict[str, Any] = about["begun"]

    def require(self, values: Mapping[str, Any]) -> None:
        """Raise TronError, naming the first key that differs, unless the checkpoint was made with these."""
        mend = "give the same settings, another output_dir, or overwrite=true"
        require_same(self.made_with, values, self.path, "a checkpoint", mend)

    def surfels(self, rates: Mapping[str, float], device: str | torch.device) -> LearntSurfels:
        """The surfels as they were, moments of Adam included."""
        try:
            return LearntSurfels.of_state(self.tensors, rates, str(device))
        except KeyError as error:
            raise TronError(f"the checkpoint lacks {error}", self.path, "remove it to begin anew") from error

    def resume(self, stage: Stage) -> None:
        """Bring a stage that holds :meth:`surfels` to the checkpoint's step."""
        stage.step, stage.psnr = self.step, self.psnr
        if stage.plan.density is not None:
            stage.plan.density.restore(self.tensors, stage.surfels.device)
        for part in (stage.exposures, stage.bystanders):
            if part is not None:
                part.restore(self.tensors)
        if stage.fused is not None:
            stage.fused.restore(self.tensors, stage.surfels.device)
