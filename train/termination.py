"""SIGTERM while training: the step in hand is finished, a checkpoint written, and the process ends."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback

log = logging.getLogger(__name__)

TERMINATED = 128 + signal.SIGTERM
"""Exit code of a command that SIGTERM has ended."""
SAME_SECONDS = 5.0
"""Seconds in which further SIGTERMs say nothing new: `timeout` and Slurm tell every process of a group, and
the command that started some of them tells these too.
"""


class Terminated(SystemExit):
    """End of a process by SIGTERM."""

    def __init__(self) -> None:
        super().__init__(TERMINATED)


class CheckpointOnTermination(Callback):
    """Ends all processes of a run behind one step and a checkpoint, once SIGTERM has reached one of them.

    A later SIGTERM ends its process at once. Lightning's own handler talks to the other processes from
    within the signal, amid whatever they are saying to each other; so it is replaced while training runs.

    Args:
        path: of the checkpoint after a step.
    """

    def __init__(self, path: Callable[[int], Path]):
        self.path = path
        self._asked_at: float | None = None
        self._before: Any = None

    @property
    def asked(self) -> bool:
        """Whether SIGTERM has come."""
        return self._asked_at is not None

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Take over the signal."""
        del trainer, pl_module
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGTERM, self._note)

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Stop here where any process was asked to."""
        del outputs, batch, batch_idx
        step = trainer.global_step
        if pl_module.device.type != "cpu" and step % 10:  # asking the others waits for the GPU
            return
        asked = torch.tensor(float(self.asked), device=pl_module.device)
        if trainer.strategy.reduce(asked, reduce_op="sum").item() > 0:
            trainer.save_checkpoint(self.path(step))
            log.info("Terminated at step %d; the same command goes on from here", step)
            raise Terminated

    def on_train_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Give the signal back, and follow it if it came after the last step."""
        del trainer, pl_module
        self._give_back()
        if self.asked:
            raise Terminated

    def on_exception(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, exception: BaseException
    ) -> None:
        """Give the signal back."""
        del trainer, pl_module, exception
        self._give_back()

    def _give_back(self) -> None:
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)
            self._before = None

    def _note(self, _signum: int, _frame: object) -> None:
        now = time.monotonic()
        if self._asked_at is None:
            self._asked_at = now
        elif now - self._asked_at >= SAME_SECONDS:
            raise Terminated
