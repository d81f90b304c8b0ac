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
    """Shows loss and validation PSNR on a bar (plain lines where there is no terminal) and in metrics.csv.

    metrics.csv has one row every `every` steps and at every checkpoint: stage, step, seconds of this stage,
    smoothed loss (as trained: squared error of values in [-1, 1], plus LPIPS if on), learning rate, how many
    of the stage's samples so far stood in for damaged ones, and the latest validation's PSNR in dB. Loggers
    get the same numbers. A resumed run goes on behind the rows it had reached.

    Args:
        path: of metrics.csv. stage: that is trained. clock: its progress. damage: its count.
        every: steps between rows. first_step: of the stage, where an earlier session left it.
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
        """Note the loss of a step."""
        del pl_module, batch, batch_idx
        step = trainer.global_step
        # Reading a number from a GPU waits for it, and from other processes too: there not at every step.
        if outputs["loss"].device.type == "cpu" or step % 10 == 0 or self.loss != self.loss:
            loss = trainer.strategy.reduce(outputs["loss"].detach(), reduce_op="mean").item()
            self.loss = loss if self.loss != self.loss else SMOOTHING * self.loss + (1 - SMOOTHING) * loss
        if not trainer.is_global_zero:
            return
        if step % self.every == 0:
            self._note(trainer)
        self._show(trainer)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Note the PSNR of a validation."""
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
        """Leave the terminal in order."""
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
        """The running mean goes into checkpoints."""
        return {"loss": self.loss}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """The running mean goes on from a checkpoint."""
        self.loss = state_dict["loss"]

    def _note(self, trainer: lightning.Trainer) -> None:
        """Add the row of this step, or bring it up to date."""
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
    """Rows of metrics.csv up to a step of a stage: those of earlier stages, and of this one up to there."""
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


log = logging.getLogger(__name__)

LINE = "stopping behind the step in hand, with a checkpoint; once more after five seconds stops at once"


class Stopped(SystemExit):
    """End of training behind a step and its checkpoint, since SIGTERM or SIGINT has reached a process."""

    def __init__(self, signum: int) -> None:
        super().__init__(128 + signum)
        self.signum = signum


class CheckpointOnTermination(Callback):
    """Ends all processes of a run behind one step and a checkpoint, once a signal has reached one of them.

    Before the first step a signal ends the process at once. Lightning's own handlers talk to the other
    processes from within the signal, amid whatever they are saying to each other, and end a step that Ctrl-C
    interrupts without a checkpoint; so they are replaced from the first step until the stage's end is kept.

    Args:
        path: of the checkpoint after a step.
        until: closed once the stage's end is kept; a signal that came late then takes effect.
    """

    def __init__(self, path: Callable[[int], Path], until: ExitStack):
        self.path, self.until = path, until
        self._termination = Termination()

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Take over the signals."""
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
        """Stop here where any process was asked to."""
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
    """Average a of the weights w, after every step a + (1 - d) (w - a) with decay d.

    Validation sees the averages, and a stage ends with them: its file holds them and the next stage starts
    from them. A checkpoint holds both. Buffers, such as a codec's normalisation, are constants and are not
    averaged. Frozen weights stay as they are, which Lightning's own d a + (1 - d) w does not grant: rounding
    moves them.
    """

    def __init__(self, decay: float):
        super().__init__(use_buffers=False, multi_avg_fn=get_ema_multi_avg_fn(decay))
