"""Progress of a training run, on a bar and in metrics.csv."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import lightning
from lightning.pytorch.callbacks import Callback

from train.curriculum import Stage, StageClock
from train.damage import DamageCount
from tron.cli.progress import Progress
from tron.storage import write_atomic

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
        if outputs["loss"].device.type == "cpu" or step % 10 == 0:
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
