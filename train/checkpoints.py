"""Checkpoints that survive a kill at any moment, and the position that a run resumes from.

`checkpoints/2-adapt-00001500.ckpt` holds everything to continue stage 2 from step 1500. A finished stage
leaves `checkpoints/2-adapt.safetensors`, the renderer at its end, and its `.ckpt` is removed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from train.curriculum import Stage
from tron.errors import TronError
from tron.storage import atomic_path


class AtomicCheckpoints(TorchCheckpointIO):
    """Lightning's checkpoints, written by fsync and rename and read without unpickling."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write a checkpoint atomically."""
        if storage_options is not None:
            raise TypeError("storage options are not used")
        with atomic_path(path) as temporary:
            torch.save(checkpoint, temporary)

    def load_checkpoint(
        self, path: Any, map_location: Any = "cpu", weights_only: bool | None = True
    ) -> dict[str, Any]:
        """Read a checkpoint; always with weights_only, so that nothing in the file is executed."""
        del weights_only
        with damage_told(path):
            return torch.load(path, map_location=map_location, weights_only=True)


@contextmanager
def damage_told(path: Any) -> Iterator[None]:
    """Turn any error of reading a damaged checkpoint into a TronError; torch raises a dozen types."""
    try:
        yield
    except Exception as error:
        mend = "remove it to start from the one before"
        raise TronError("checkpoint is damaged", str(path), mend) from error


def periodic_checkpoint(folder: Path, number: int, stage: Stage, every: int) -> ModelCheckpoint:
    """Make the callback that writes the run's whole state every `every` steps and keeps the newest."""
    return ModelCheckpoint(
        dirpath=folder,
        filename=_name(number, stage),
        auto_insert_metric_name=False,
        every_n_train_steps=every,
        save_top_k=1,
        save_on_train_epoch_end=False,
        enable_version_counter=False,
    )


def checkpoint_path(folder: Path, number: int, stage: Stage, step: int) -> Path:
    """Path of the checkpoint after a stage's step, as `periodic_checkpoint` names it."""
    return folder / f"{_name(number, stage).format(step=step)}.ckpt"


def _name(number: int, stage: Stage) -> str:
    """File name pattern of a stage's checkpoints; Lightning and str.format fill in the step."""
    return f"{number}-{stage.name}-{{step:08d}}"


def _checkpoints(folder: Path, number: int, stage: Stage) -> dict[int, Path]:
    """A stage's checkpoints: step -> file."""
    found = {}
    for path in folder.glob("*.ckpt"):
        step = path.stem.rpartition("-")[2]
        if step.isdecimal() and path == checkpoint_path(folder, number, stage, int(step)):
            found[int(step)] = path
    return found


def stage_end(folder: Path, number: int, stage: Stage) -> Path:
    """File of the renderer at a stage's end."""
    return folder / f"{number}-{stage.name}.safetensors"


@dataclass(frozen=True)
class Position:
    """Position of a run: the stage to run next (from 0), its first step, and the checkpoint to read."""

    stage: int
    step: int = 0
    checkpoint: Path | None = None


def find_position(folder: Path, stages: Sequence[Stage]) -> Position:
    """Find the position to resume from in a folder of checkpoints; stage == len(stages): finished."""
    for index, stage in enumerate(stages):
        if stage_end(folder, index + 1, stage).is_file():
            continue
        steps = _checkpoints(folder, index + 1, stage)
        if not steps:
            return Position(index)
        return Position(index, max(steps), steps[max(steps)])
    return Position(len(stages))


def remove_checkpoints(folder: Path, number: int, stage: Stage) -> None:
    """Remove a stage's `.ckpt` files, once its renderer is saved."""
    for path in _checkpoints(folder, number, stage).values():
        path.unlink()
