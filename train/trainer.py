"""Lightning's trainer of a stage, and what watches it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import lightning
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.strategies import DDPStrategy, Strategy

from train.averaging import AveragedWeights
from train.callbacks import TrainingLog, earlier_rows, steps_before
from train.checkpoints import AtomicCheckpoints, Position, checkpoint_path, periodic_checkpoint
from train.curriculum import Stage, StageClock
from train.damage import DamageCount
from train.data import TrainingData
from train.loggers import RunLoggers
from train.processes import Processes
from train.settings import Settings
from train.sharding import ShardedStrategy
from train.strips import ValidationStrips
from train.termination import CheckpointOnTermination


def make_trainer(
    settings: Settings,
    position: Position,
    clock: StageClock,
    data: TrainingData,
    processes: Processes,
    loggers: RunLoggers,
) -> lightning.Trainer:
    """Trainer of the stage that `data` has begun, from a position on."""
    stage = data.stage
    assert stage is not None
    earlier = steps_before(earlier_rows(_metrics(settings), stage.name, position.step), stage.name)
    return lightning.Trainer(
        max_steps=stage.steps if clock.seconds_limit is None else -1,
        max_epochs=-1,
        accelerator=settings.accelerator,
        devices=settings.devices if processes.count == 1 else processes.count // settings.nodes,
        num_nodes=settings.nodes,
        strategy=_strategy(settings, processes),
        use_distributed_sampler=False,
        precision=settings.precision,  # type: ignore[arg-type]
        gradient_clip_val=settings.optimizer.gradient_clip,
        val_check_interval=min(settings.validation.every, stage.steps),
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        limit_val_batches=0 if data.validation_split is None else 1.0,
        callbacks=_callbacks(settings, position, stage, clock, data, earlier),
        plugins=[AtomicCheckpoints()],
        logger=loggers.of_stage(earlier + position.step) if processes.first else False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=settings.output_dir,
    )


def _strategy(settings: Settings, processes: Processes) -> Literal["auto"] | Strategy:
    if settings.strategy == "fsdp":
        return ShardedStrategy(processes)
    # Buffers are constants here; broadcasting them would also tie together how often ranks validate.
    return "auto" if processes.count == 1 else DDPStrategy(broadcast_buffers=False)


def _metrics(settings: Settings) -> Path:
    return settings.output_dir / "metrics.csv"


def _callbacks(
    settings: Settings,
    position: Position,
    stage: Stage,
    clock: StageClock,
    data: TrainingData,
    earlier: int,
) -> list[Callback]:
    """In this order: averages are formed and shown before anything else looks at the weights."""
    folder, number = settings.output_dir / "checkpoints", position.stage + 1
    decay = settings.optimizer.ema_decay
    damage = DamageCount(stage, settings.data.damaged_limit, settings.checkpoint_every)
    return [
        *([] if decay is None else [AveragedWeights(decay)]),
        damage,
        TrainingLog(_metrics(settings), stage, clock, damage, first_step=position.step),
        ValidationStrips(settings.output_dir, stage, data, earlier),
        CheckpointOnTermination(lambda step: checkpoint_path(folder, number, stage, step)),
        periodic_checkpoint(folder, number, stage, settings.checkpoint_every),
    ]
