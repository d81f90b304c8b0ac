"""One training run: stage after stage, from wherever it was left."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import lightning
import torch
import yaml
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging
from lightning.pytorch.strategies import DDPStrategy

from train.callbacks import TrainingLog
from train.checkpoints import (
    AtomicCheckpoints,
    Position,
    find_position,
    periodic_checkpoint,
    remove_checkpoints,
    stage_end,
)
from train.curriculum import Stage, StageClock
from train.data import TrainingData
from train.module import RendererModule
from train.processes import Processes, launch
from train.settings import Settings
from train.sharding import ShardedModule, ShardedStrategy, require_shardable
from train.splits import manifest_hash, split_hashes
from train.transformer_options import apply_options, require_compiler
from tron import seeds
from tron.claim import read_recipe, require_same
from tron.cli.instantiation import make
from tron.cli.recipes import model_defaults
from tron.errors import TronError
from tron.neural.losses import RendererLoss
from tron.neural.protocols import Renderer
from tron.neural.weights import restore_renderer, save_renderer
from tron.runtime import set_torch_threads
from tron.storage import locked, write_atomic

log = logging.getLogger(__name__)

RENDERER_NAME = "renderer.safetensors"


def run(settings: Settings) -> None:
    """Train a neural renderer on a dataset through the stages of a curriculum, on one device or several.

    Ends with output_dir/renderer.safetensors. A run that was interrupted goes on from its last checkpoint
    when the same command is given again; a finished one is left as it is.
    """
    launch(train, settings)


def train(processes: Processes, settings: Settings) -> None:
    """Work of each process of a run; the first holds the folder and writes."""
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
        position = processes.from_first(lambda: _claim(held, settings, processes.count, stages))
        if position is None:
            return
        module = processes.together(lambda: _make_module(settings, stages, position, data))
        if position == Position(0):
            _calibrate(module.renderer, data, stages, processes)
        for index in range(position.stage, len(stages)):
            here = position if index == position.stage else Position(index)
            _run_stage(settings, stages, here, module, data, processes)
            processes.from_first(partial(_end_stage, folder, index + 1, stages[index], module))
        path = settings.output_dir / RENDERER_NAME
        processes.from_first(lambda: save_renderer(path, module.renderer))
        log.info("Renderer: %s", path)


def _claim(held: ExitStack, settings: Settings, processes: int, stages: list[Stage]) -> Position | None:
    """Hold the output folder, make it this run's, and find where it stands; None if it is finished."""
    held.enter_context(locked(settings.output_dir))
    _claim_settings(settings, processes)
    position = find_position(settings.output_dir / "checkpoints", stages)
    if position.stage == len(stages) and (settings.output_dir / RENDERER_NAME).is_file():
        log.info("%s is trained already", settings.output_dir / RENDERER_NAME)
        return None
    return position


def _make_module(
    settings: Settings, stages: list[Stage], position: Position, data: TrainingData
) -> RendererModule:
    """The renderer as the stage before the position left it, with its loss; the data are opened for it."""
    torch.manual_seed(seeds.integer(settings.seed, "train", "weights", bits=63))
    renderer = build_renderer(settings.renderer)
    apply_options(renderer, settings)
    module = RendererModule(renderer, RendererLoss(**settings.loss.model_dump()), settings.optimizer)
    data.open(stages, renderer.config.guidance)
    if position.stage > 0:
        folder = settings.output_dir / "checkpoints"
        restore_renderer(stage_end(folder, position.stage, stages[position.stage - 1]), renderer)
    return module


def _calibrate(renderer: Renderer, data: TrainingData, stages: list[Stage], processes: Processes) -> None:
    """Calibrate in the first process; the constants of the others become its own."""

    def constants() -> dict[str, torch.Tensor]:
        renderer.calibrate(data.calibration(stages, renderer.temporal_factor))
        return dict(renderer.named_buffers())

    for name, value in processes.from_first(constants).items():
        renderer.get_buffer(name).copy_(value)


def build_renderer(recipe: dict[str, Any]) -> Renderer:
    """Make the renderer that a recipe's `_target_` names; TronError where the recipe does not fit it."""
    renderer = make(recipe, "renderer")
    if not isinstance(renderer, Renderer):
        raise TronError(f"renderer._target_ makes a {type(renderer).__name__}, not a renderer")
    return renderer


def _run_stage(
    settings: Settings,
    stages: list[Stage],
    position: Position,
    module: RendererModule,
    data: TrainingData,
    processes: Processes,
) -> None:
    number, stage = position.stage + 1, stages[position.stage]
    folder = settings.output_dir / "checkpoints"
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
    callbacks: list[Callback] = [
        TrainingLog(settings.output_dir / "metrics.csv", stage, clock, first_step=position.step),
        periodic_checkpoint(folder, number, stage, settings.checkpoint_every),
    ]
    if settings.optimizer.ema_decay is not None:
        # The codec's normalisation is a buffer: averaging it would mix it with itself, so only weights are.
        callbacks.insert(0, EMAWeightAveraging(decay=settings.optimizer.ema_decay, use_buffers=False))
    trainer = lightning.Trainer(
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
        callbacks=callbacks,
        plugins=[AtomicCheckpoints()],
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=settings.output_dir,
    )
    try:
        trainer.fit(trained, datamodule=data, ckpt_path=position.checkpoint, weights_only=True)
    except SystemExit as error:  # Lightning turns an interrupt into exit(1)
        raise KeyboardInterrupt from error
    if trainer.interrupted:
        raise KeyboardInterrupt
    if isinstance(trained, ShardedModule):
        trained.give_weights_to(module)


def _strategy(settings: Settings, processes: Processes) -> Any:
    if settings.strategy == "fsdp":
        return ShardedStrategy(processes)
    # Buffers are constants here; broadcasting them would also tie together how often ranks validate.
    return "auto" if processes.count == 1 else DDPStrategy(broadcast_buffers=False)


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


def _claim_settings(settings: Settings, processes: int) -> None:
    """Write config.yaml, or find that this folder holds a run of other settings, data or batches.

    Batches are as many as there are processes: the run remembers their number, not how they were spread.
    """
    path = settings.output_dir / "config.yaml"
    described = yaml.safe_load(yaml.safe_dump(settings.model_dump(mode="json")))
    described["dataset_sha256"] = manifest_hash(settings.dataset)
    described["splits_sha256"] = split_hashes(settings.splits)
    described["processes"] = processes
    earlier = read_recipe(path)
    if earlier is None:
        write_atomic(path, yaml.safe_dump(described, sort_keys=False))
        return
    # A run may move; its data are known by their hash.
    kept = [key for key in described if key not in ("output_dir", "dataset", "splits", "devices", "nodes")]
    before, now = ({key: each[key] for key in kept if key in each} for each in (earlier, described))
    defaults = {**model_defaults(Settings), "processes": 1, "splits_sha256": {}}
    require_same(before, now, settings.output_dir, "a run", defaults=defaults)
