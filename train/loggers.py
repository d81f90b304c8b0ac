"""Loggers beside metrics.csv, by name: TensorBoard and Weights & Biases, both into output_dir, offline."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import numpy as np
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger

from train.settings import LoggerName
from tron.errors import TronError


class RunLoggers:
    """Loggers of a run.

    Args:
        names: loggers to use; metrics.csv is always written and has no name here.
        folder: output_dir; TensorBoard writes into its tensorboard/, wandb into its wandb/.
        run: hexadecimal hash of the run's settings; wandb joins the sessions of a run by it.

    Raises:
        TronError: a package is not installed.
    """

    def __init__(self, names: Sequence[LoggerName], folder: Path, run: str):
        self.names, self.folder = set(names), folder
        for name in sorted(self.names - {"csv"}):
            try:
                # Both names are literals: a test reads them, to compare imports with pyproject.toml.
                import_module("tensorboard") if name == "tensorboard" else import_module("wandb")
            except ImportError as error:
                raise TronError(
                    f"logger={name} needs a package that is not installed",
                    mend="pip install 'tron-relight[loggers]', or leave it out",
                ) from error
        self._run = run
        self._wandb: WandbLogger | None = None

    def of_stage(self, first_step: int) -> list[Logger]:
        """Loggers of a stage that continues after a step of the run; rows of later steps are discarded."""
        loggers: list[Logger] = []
        if "tensorboard" in self.names:
            loggers.append(TensorBoardLogger(self.folder, "tensorboard", "", purge_step=first_step + 1))
        if "wandb" in self.names:
            self._wandb = self._wandb or self._offline_run()
            loggers.append(self._wandb)
        return loggers

    def close(self) -> None:
        """Flush and close."""
        if self._wandb is not None:
            self._wandb.experiment.finish()
            self._wandb = None

    def _offline_run(self) -> WandbLogger:
        quiet = import_module("wandb").Settings(silent=True, console="off", disable_git=True, save_code=False)
        return WandbLogger(
            name=self.folder.name,
            save_dir=self.folder,
            id=self._run[:16],
            project="tron",
            offline=True,
            settings=quiet,
        )


def log_picture(logger: Logger, name: str, picture: np.ndarray, step: int) -> None:
    """Log a picture (H, W, 3) uint8, display values, under a step of the run."""
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_image(name, picture, step, dataformats="HWC")
    elif isinstance(logger, WandbLogger):
        logger.log_image(name, [picture], step)
