"""One training run: stage after stage, resumed from where it stopped."""

from __future__ import annotations

import hashlib
import logging
import signal
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Literal

import hydra.utils
import lightning
import torch
import yaml
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.strategies import DDPStrategy, Strategy

from train.callbacks import (
    AveragedWeights,
    CheckpointOnTermination,
    DamageCount,
    Stopped,
    TrainingLog,
    earlier_rows,
    steps_before,
)
from train.checkpoints import (
    AtomicCheckpoints,
    Position,
    checkpoint_path,
    find_position,
    periodic_checkpoint,
    remove_checkpoints,
    stage_end,
)
from train.curriculum import Stage, StageClock
from train.examples.data import TrainingData
from train.examples.requirements import require_drawing, require_renderer
from train.examples.splits import manifest_hash, split_hashes
from train.loggers import RunLoggers
from train.module import RendererModule
from train.processes import Processes, launch
from train.settings import Settings
from train.sharding import ShardedModule, ShardedStrategy, require_shardable
from train.strips import ValidationStrips
from train.transformer_options import apply_options, require_compiler
from tron import seeds
from tron.cli.instantiation import make
from tron.errors import TronError
from tron.neural.kinds import config_class
from tron.neural.losses import RendererLoss
from tron.neural.protocols import Renderer
from tron.neural.shipped import checkpoint_file
from tron.neural.weights import require_saved, restore_renderer, save_renderer
from tron.run_folder import RunFolder
from tron.runtime import set_torch_threads
from tron.storage import locked, sha256

log = logging.getLogger(__name__)

RENDERER_NAME = "renderer.safetensors"
MAY_CHANGE = ("output_dir", "dataset", "splits", "start_from", "devices", "nodes", "logger")
"""Settings that may change when a run resumes; data and first weights are compared by hash instead."""


def run(settings: Settings) -> None:
    """Train a neural renderer on a dataset through the stages of a curriculum, on one device or several.

    Ends with output_dir/renderer.safetensors. A run that was interrupted goes on from its last checkpoint
    when the same command is given again; a finished one is left as it is.
    """
    launch(train, settings)


def train(processes: Processes, settings: Settings) -> None:
    """The work of each process of a run; the first locks the folder and writes."""
    if settings.threads is not None:
        set_torch_threads(settings.threads)
    stages = [stage for stage in settings.stages if stage.steps > 0]
    require_shardable(settings, processes)
    processes.together(lambda: require_compiler(settings))
    data = processes.together(
        lambda: TrainingData(
            settings.dataset, settings.data, settings.seed, settings.validation, processes, settings.splits
        )
    )
    with ExitStack() as held:
        folder = settings.output_dir / "checkpoints"
        described = processes.from_first(lambda: _described(settings, processes.count))
        loggers = processes.together(partial(_loggers, settings, described))
        held.callback(loggers.close)
        position = processes.from_first(lambda: _claim(held, settings, described, stages))
        if position is None:
            return
        module = processes.together(lambda: _make_module(settings, stages, position, data))
        # Only now: a first attempt with wrong settings must not bind the second one to them.
        processes.from_first(lambda: _keep_settings(settings, described))
        if position == Position(0) and settings.start_from is None:
            _calibrate(module.renderer, data, stages, processes)
        for index in range(position.stage, len(stages)):
            here = position if index == position.stage else Position(index)
            with ExitStack() as kept:  # from the first step on, signals wait until it is closed
                _run_stage(settings, stages, here, module, data, processes, loggers, kept)
                processes.from_first(partial(_end_stage, folder, index + 1, stages[index], module))
        path = settings.output_dir / RENDERER_NAME
        processes.from_first(lambda: save_renderer(path, module.renderer))
        log.info("Renderer: %s", path)


def _described(settings: Settings, processes: int) -> dict[str, Any]:
    """Settings as plain values, with the hashes of the files they name.

    Batch size grows with the number of processes, so the run records their total, not their layout.
    TronError if the dataset or `start_from` cannot be read.
    """
    described = yaml.safe_load(yaml.safe_dump(settings.model_dump(mode="json")))
    described["dataset_sha256"] = manifest_hash(settings.dataset)
    described["splits_sha256"] = split_hashes(settings.splits)
    described["start_from_sha256"] = (
        sha256(checkpoint_file(settings.start_from)) if settings.start_from else None
    )
    described["processes"] = processes
    return described


def _loggers(settings: Settings, described: dict[str, Any]) -> RunLoggers:
    run = hashlib.sha256(yaml.safe_dump(described).encode()).hexdigest()
    return RunLoggers(settings.logger, settings.output_dir, run)


def _claim(
    held: ExitStack, settings: Settings, described: dict[str, Any], stages: list[Stage]
) -> Position | None:
    """Lock the output folder, which must be this run's, and find its position; None if it is finished."""
    held.enter_context(locked(settings.output_dir))
    kept = [key for key in described if key not in MAY_CHANGE]
    earlier = RunFolder(settings.output_dir).recipe() or described
    before, now = ({key: each[key] for key in kept if key in each} for each in (earlier, described))
    RunFolder(settings.output_dir).require(now, before)
    position = find_position(settings.output_dir / "checkpoints", stages)
    if position.stage == len(stages) and (settings.output_dir / RENDERER_NAME).is_file():
        log.info("%s is trained already", settings.output_dir / RENDERER_NAME)
        return None
    return position


def _keep_settings(settings: Settings, described: dict[str, Any]) -> None:
    if RunFolder(settings.output_dir).recipe() is None:
        RunFolder(settings.output_dir).keep(described)


def _make_module(
    settings: Settings, stages: list[Stage], position: Position, data: TrainingData
) -> RendererModule:
    """Open the data and make the module, with the renderer's weights from before the position."""
    torch.manual_seed(seeds.integer(settings.seed, "train", "weights", bits=63))
    renderer = build_renderer(settings.renderer)
    for stage in stages:
        require_renderer(stage, renderer)
    require_drawing(renderer, stages)
    if position == Position(0) and settings.start_from is not None:
        restore_renderer(checkpoint_file(settings.start_from), renderer)
    apply_options(renderer, settings)
    module = RendererModule(renderer, RendererLoss(**settings.loss.model_dump()), settings.optimizer)
    data.open(stages, renderer.config.guidance)
    if position.stage > 0:
        folder = settings.output_dir / "checkpoints"
        restore_renderer(stage_end(folder, position.stage, stages[position.stage - 1]), renderer)
    return module


def _calibrate(renderer: Renderer, data: TrainingData, stages: list[Stage], processes: Processes) -> None:
    """Calibrate in the first process and copy its constants to the others."""

    def constants() -> dict[str, torch.Tensor]:
        renderer.calibrate(data.calibration(stages, renderer.temporal_factor))
        return dict(renderer.named_buffers())

    for name, value in processes.from_first(constants).items():
        renderer.get_buffer(name).copy_(value)


def build_renderer(recipe: dict[str, Any]) -> Renderer:
    """Make the renderer that a recipe's `_target_` names, TRON's or the user's.

    Raises:
        TronError: the recipe does not fit it, it is no Renderer, or its weights could not be reloaded.
    """
    renderer = make(_with_settings(recipe), "renderer")
    if not isinstance(renderer, Renderer):
        raise TronError(
            f"renderer._target_ makes a {type(renderer).__name__}, not a renderer",
            mend="derive its class from tron.neural.protocols.Renderer",
        )
    require_saved(renderer)
    return renderer


def _with_settings(recipe: dict[str, Any]) -> dict[str, Any]:
    """Add the class to a recipe's `config`, if its `_target_` is a renderer that declares one.

    Raises:
        TronError: the recipe names another class, such as the default network's.
    """
    config = recipe.get("config")
    try:
        cls = hydra.utils.get_class(recipe["_target_"])
        given = hydra.utils.get_class(config["_target_"]) if config and "_target_" in config else None
    except Exception:  # its construction will report the error
        return recipe
    if not isinstance(config, dict) or not issubclass(cls, Renderer):
        return recipe
    settings = config_class(cls)
    if given is None:
        return {**recipe, "config": {"_target_": f"{settings.__module__}.{settings.__qualname__}", **config}}
    if not issubclass(given, settings):
        raise TronError(
            f"{recipe['_target_']} takes settings of {settings.__name__}, not {given.__name__}",
            mend="write renderer/NAME.yaml with its _target_ and config in a folder for --config-dir",
        )
    return recipe


def _run_stage(
    settings: Settings,
    stages: list[Stage],
    position: Position,
    module: RendererModule,
    data: TrainingData,
    processes: Processes,
    loggers: RunLoggers,
    kept: ExitStack,
) -> None:
    number, stage = position.stage + 1, stages[position.stage]
    share = stage.steps / sum(each.steps for each in stages)
    limit = settings.max_seconds * share if settings.max_seconds else None
    clock = StageClock(stage.steps, limit, processes.number_of_first)
    _announce(number, stages, settings.max_seconds, position.step, _kind(data, stage.split))
    if position.checkpoint and clock.seconds_limit is None and position.step >= stage.steps:
        # Interrupted between its last step and its end: Lightning would not even start, nor average weights.
        checkpoint = position.checkpoint
        state = processes.together(lambda: AtomicCheckpoints().load_checkpoint(checkpoint)["state_dict"])
        module.load_state_dict(state)
        return
    trained = ShardedModule(module, settings) if settings.strategy == "fsdp" else module
    trained.begin(stage, clock)
    data.begin(stage, position.step)
    trainer = make_trainer(settings, position, clock, data, processes, loggers, kept)
    try:
        trainer.fit(trained, datamodule=data, ckpt_path=position.checkpoint, weights_only=True)
    except Stopped as stopped:
        if stopped.signum == signal.SIGINT:
            raise KeyboardInterrupt from stopped
        raise
    except SystemExit as error:  # Lightning turns an interrupt into exit(1)
        raise KeyboardInterrupt from error
    if trainer.interrupted:
        raise KeyboardInterrupt
    if isinstance(trained, ShardedModule):
        trained.give_weights_to(module)


def _end_stage(folder: Path, number: int, stage: Stage, module: RendererModule) -> None:
    save_renderer(stage_end(folder, number, stage), module.renderer)
    remove_checkpoints(folder, number, stage)


def _announce(
    number: int, stages: list[Stage], max_seconds: float | None, first_step: int, kind: str
) -> None:
    stage = stages[number - 1]
    length = f"{stage.steps} steps"
    if max_seconds is not None:
        length = f"{max_seconds * stage.steps / sum(each.steps for each in stages):.0f} s"
    mixed = f", {stage.rehearsal_ratio:.0%} from '{stage.rehearsal_split}'" if len(stage.splits()) > 1 else ""
    log.info(
        "Stage %d of %d, %s: split '%s'%s%s, K = %d, %s%s",
        number,
        len(stages),
        stage.name,
        stage.split,
        kind,
        mixed,
        stage.frames,
        length,
        f", from step {first_step}" if first_step else "",
    )


def _kind(data: TrainingData, split: str) -> str:
    if data.stands_in(split):
        return " (path-traced, it stands in for photographs)"
    return " (photographs)" if data.photographs(split) else ""


def make_trainer(
    settings: Settings,
    position: Position,
    clock: StageClock,
    data: TrainingData,
    processes: Processes,
    loggers: RunLoggers,
    kept: ExitStack,
) -> lightning.Trainer:
    """Trainer for the stage that `data` has begun, from a position on; signals wait until `kept` closes."""
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
        precision=settings.precision,
        gradient_clip_val=settings.optimizer.gradient_clip,
        val_check_interval=min(settings.validation.every, stage.steps),
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        limit_val_batches=0 if data.validation_split is None else 1.0,
        callbacks=_callbacks(settings, position, stage, clock, data, earlier, kept),
        plugins=[AtomicCheckpoints()],
        logger=loggers.of_stage(earlier + position.step) if processes.first else False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=settings.output_dir,
    )


def _strategy(settings: Settings, processes: Processes) -> Literal["auto"] | Strategy:
    if settings.strategy == "fsdp":
        return ShardedStrategy(processes)
    # Buffers are constants here; broadcasting them would also force all ranks to validate equally often.
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
    kept: ExitStack,
) -> list[Callback]:
    """Callbacks in order: weights are averaged and swapped in before any other callback reads them."""
    folder, number = settings.output_dir / "checkpoints", position.stage + 1
    decay = settings.optimizer.ema_decay
    damage = DamageCount(stage, settings.data.damaged_limit, settings.checkpoint_every)
    return [
        *([] if decay is None else [AveragedWeights(decay)]),
        damage,
        TrainingLog(_metrics(settings), stage, clock, damage, first_step=position.step),
        ValidationStrips(settings.output_dir, stage, data, earlier),
        CheckpointOnTermination(lambda step: checkpoint_path(folder, number, stage, step), kept),
        periodic_checkpoint(folder, number, stage, settings.checkpoint_every),
    ]
