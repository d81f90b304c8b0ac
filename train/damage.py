"""Count of the samples that stand in for damaged ones, and the share of them that ends a run."""

from __future__ import annotations

from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from train.curriculum import Stage
from train.data import DAMAGED
from tron.errors import TronError

FEWEST = 1000
"""Samples that a share is taken of at least: of the first few, one damaged sample would be too many."""


class DamageCount(Callback):
    """Number of a stage's samples, in all processes, that stand in for damaged ones; part of checkpoints.

    Args:
        stage: that is trained.
        limit: share of its samples beyond which TronError ends the run, in all processes at once.
        checkpoint_every: steps between checkpoints, which have the number up to their step.
    """

    def __init__(self, stage: Stage, limit: float, checkpoint_every: int):
        self.stage, self.limit, self.checkpoint_every = stage, limit, checkpoint_every
        self.total = 0
        self._new: Tensor | None = None

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: dict[str, Tensor],
        batch_idx: int,
    ) -> None:
        """Count a batch's."""
        del pl_module, outputs, batch_idx
        new = batch[DAMAGED]
        self._new = new if self._new is None else self._new + new
        step = trainer.global_step
        # Reading a number from a GPU waits for it.
        if new.device.type == "cpu" or step % 10 == 0 or step % self.checkpoint_every == 0:
            self._collect(trainer)

    def on_train_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Count the last ones."""
        del pl_module
        if self._new is not None:
            self._collect(trainer)

    def state_dict(self) -> dict[str, Any]:
        """The number goes into checkpoints."""
        return {"total": self.total}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """The number goes on from a checkpoint."""
        self.total = state_dict["total"]

    def _collect(self, trainer: lightning.Trainer) -> None:
        assert self._new is not None
        self.total += int(trainer.strategy.reduce(self._new.to(torch.float32), reduce_op="sum").item())
        self._new = None
        samples = trainer.global_step * self.stage.batch_size * trainer.world_size
        if self.total > self.limit * max(samples, FEWEST):
            raise TronError(
                f"stage {self.stage.name}: {self.total} of {samples} samples were damaged, more than "
                f"data.damaged_limit={self.limit:g} of them",
                mend="make the damaged clips, which the log names, again; or raise the limit",
            )
