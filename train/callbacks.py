"""Progress of a training run, on a bar and in metrics.csv."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, WeightAveraging
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

from train.curriculum import Stage, StageClock
from train.examples.data import DAMAGED
from tron.cli.progress import Progress
from tron.errors import TronError
from tron.storage import write_atomic
from tron.termination import Termination, termination_noted

SMOOTHING = 0.98


class TrainingLog(Callback):
    """Shows loss and validation PSNR on a bar (without a terminal: plain lines) and in metrics.csv.

    metrics.csv has one row every `every` steps and at every checkpoint: stage, step, seconds of this stage,
    smoothed training loss (see `tron.neural.losses`), learning rate, how many of
    the stage's samples so far replaced damaged ones, and the latest validation's PSNR in dB. Loggers get the
    same numbers. A resumed run continues after the rows up to its checkpoint.

    Args:
        path: metrics.csv. stage: the one being trained. clock: its progress. damage: its count.
        every: steps between rows. first_step: first step of this session within the stage.
    """

    columns: tuple[str, ...] = (
        "stage",
        "step",
        "seconds",
        "loss",
        "learning_rate",
        "damaged",
        "val_psnr",
        "val_psnr_full",
    )

    def __init__(
        self,
        path: Path,
        stage: Stage,
        clock: StageClock,
        damage: DamageCount,
        every: int = 50,
        first_step: int = 0,
    ):
        self.path, self.stage, self.clock, self.damage, self.every = path, stage, clock, damage, every
        self._total = clock.seconds_limit or float(stage.steps)
        self.loss = float("nan")
        self.validated: dict[str, float] = {}
        self._rows = earlier_rows(path, stage.name, first_step)
        self.steps_before = steps_before(self._rows, stage.name)
        self._progress: Progress | None = None

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Open the bar."""
        del pl_module
        if trainer.is_global_zero:
            done = self._total * self.clock.progress(trainer.global_step)
            unit = "steps" if self.clock.seconds_limit is None else "s"
            self._progress = Progress(self.stage.name, self._total, done, unit)

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Record the loss of a step."""
        del pl_module, batch, batch_idx
        step = trainer.global_step
        # Reading a number from a GPU or from other processes waits for them, so not at every step.
        if outputs["loss"].device.type == "cpu" or step % 10 == 0 or self.loss != self.loss:
            loss = trainer.strategy.reduce(outputs["loss"].detach(), reduce_op="mean").item()
            self.loss = loss if self.loss != self.loss else SMOOTHING * self.loss + (1 - SMOOTHING) * loss
        if not trainer.is_global_zero:
            return
        if step % self.every == 0:
            self._note(trainer)
        self._show(trainer)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Record the PSNR of a validation."""
        del pl_module
        named = trainer.callback_metrics
        self.validated = {name: named[name].item() for name in ("val_psnr", "val_psnr_full") if name in named}

    def on_train_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the last row and close the bar."""
        del pl_module
        if not trainer.is_global_zero:
            return
        self._note(trainer)
        self._write()
        self._show(trainer)
        self._close()

    def on_exception(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, exception: BaseException
    ) -> None:
        """Restore the terminal."""
        del trainer, pl_module, exception
        self._close()

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Write metrics.csv with each checkpoint, so that a resumed run finds the rows up to it."""
        del pl_module, checkpoint
        if trainer.is_global_zero:
            self._note(trainer)
            self._write()

    def state_dict(self) -> dict[str, Any]:
        """Save the running mean of the loss."""
        return {"loss": self.loss}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the running mean of the loss."""
        self.loss = state_dict["loss"]

    def _note(self, trainer: lightning.Trainer) -> None:
        """Add the row of this step, or update it."""
        row = self._row(trainer)
        numbers = {key: float(value) for key, value in row.items() if key not in ("stage", "step", "seconds")}
        for logger in trainer.loggers:
            logger.log_metrics(numbers, self.steps_before + trainer.global_step)
        if self._rows and all(str(self._rows[-1][name]) == str(row[name]) for name in ("stage", "step")):
            self._rows.pop()
        self._rows.append(row)

    def _row(self, trainer: lightning.Trainer) -> dict[str, Any]:
        rate = trainer.optimizers[0].param_groups[0]["lr"]
        return {
            "stage": self.stage.name,
            "step": trainer.global_step,
            "seconds": f"{self.clock.seconds():.1f}",
            "loss": f"{self.loss:.6g}",
            "learning_rate": f"{rate:.4g}",
            "damaged": self.damage.total,
            **{name: f"{value:.3f}" for name, value in self.validated.items()},
        }

    def _write(self) -> None:
        table = io.StringIO()
        writer = csv.DictWriter(table, self.columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        write_atomic(self.path, table.getvalue())

    def _show(self, trainer: lightning.Trainer) -> None:
        validated = self.validated.get("val_psnr")
        text = f"step {trainer.global_step} loss {self.loss:.5f}"
        if validated is not None:
            text += f" validation {validated:.2f} dB"
        if self._progress is not None:
            self._progress.update(self._total * self.clock.progress(trainer.global_step), text)

    def _close(self) -> None:
        if self._progress is not None:
            self._progress.close()
            self._progress = None


def steps_before(rows: list[dict[str, Any]], stage: str) -> int:
    """Steps of a run's earlier stages, from the rows of metrics.csv."""
    last = {row["stage"]: int(row["step"]) for row in rows if row["stage"] != stage}
    return sum(last.values())


def earlier_rows(path: Path, stage: str, first_step: int) -> list[dict[str, Any]]:
    """Rows of metrics.csv up to a step of a stage, with all rows of earlier stages."""
    if not path.is_file():
        return []
    kept: list[dict[str, Any]] = []
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            if row["stage"] == stage and int(row["step"]) > first_step:
                break
            kept.append(row)
    return kept


FEWEST = 1000
"""Fewest samples that the damaged share is taken of; of the first few, one would exceed any limit."""


class DamageCount(Callback):
    """Counts the samples of a stage, over all processes, that replace damaged ones; saved in checkpoints.

    Args:
        stage: the stage being trained.
        limit: share of its samples beyond which TronError ends the run, in all processes at once.
        checkpoint_every: steps between checkpoints, each with the count up to its step.
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
        """Add a batch's damaged samples."""
        del pl_module, outputs, batch_idx
        new = batch[DAMAGED]
        self._new = new if self._new is None else self._new + new
        step = trainer.global_step
        # Reading a number from a GPU waits for it.
        if new.device.type == "cpu" or step % 10 == 0 or step % self.checkpoint_every == 0:
            self._collect(trainer)

    def on_train_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Add those of the last steps."""
        del pl_module
        if self._new is not None:
            self._collect(trainer)

    def state_dict(self) -> dict[str, Any]:
        """Save the count."""
        return {"total": self.total}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the count."""
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


log = logging.getLogger(__name__)

LINE = "stopping behind the step in hand, with a checkpoint; once more after five seconds stops at once"


class Stopped(SystemExit):
    """Training ends after a step and its checkpoint, because a process received SIGTERM or SIGINT."""

    def __init__(self, signum: int) -> None:
        super().__init__(128 + signum)
        self.signum = signum


class CheckpointOnTermination(Callback):
    """Ends all processes of a run after the same step and a checkpoint, once one of them receives a signal.

    Before the first step a signal ends the process at once. Lightning's own handlers start a collective call
    within the signal handler, amid any other that is running, and leave no checkpoint when Ctrl-C interrupts
    a step; so they are replaced from the first step until the stage's result is saved.

    Args:
        path: gives the checkpoint's path after a step.
        until: closed once the stage's result is saved; a late signal then takes effect.
    """

    def __init__(self, path: Callable[[int], Path], until: ExitStack):
        self.path, self.until = path, until
        self._termination = Termination()

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Install the signal handlers."""
        del pl_module
        line = LINE if trainer.is_global_zero else ""
        self._termination = self.until.enter_context(termination_noted(line))

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Stop here if any process has received a signal."""
        del outputs, batch, batch_idx
        step = trainer.global_step
        if pl_module.device.type != "cpu" and step % 10:  # asking the others waits for the GPU
            return
        asked = torch.tensor(float(self._termination.signum or 0), device=pl_module.device)
        signum = int(trainer.strategy.reduce(asked, reduce_op="max").item())
        if signum:
            trainer.save_checkpoint(self.path(step))
            log.info("stopped: step %d is kept", step)
            raise Stopped(signum)


class AveragedWeights(WeightAveraging):
    """Exponential moving average a of the weights w: after every step a + (1 - d) (w - a), with decay d.

    Validation uses the averages. They are the stage's result: its file holds them and the next stage starts
    from them. A checkpoint holds both. Buffers, such as a codec's normalisation, are constants and are not
    averaged. Frozen weights stay exactly as they are; in Lightning's own d a + (1 - d) w, rounding would
    change them.
    """

    def __init__(self, decay: float):
        super().__init__(use_buffers=False, multi_avg_fn=get_ema_multi_avg_fn(decay))
