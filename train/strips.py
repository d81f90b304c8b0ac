"""Pictures of a validation: guidance, network and truth of a few held-out frames side by side."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from train.curriculum import Stage
from train.examples.data import TrainingData
from train.examples.framing import area_resized
from train.loggers import log_picture
from train.module import RendererModule
from tron.io.images import encode_png
from tron.neural.renderer import to_display_array
from tron.shards.schema import TARGET
from tron.storage import write_atomic

WIDEST = 384
"""Largest width of a shown frame, pixels; wider frames are downsampled by area."""
HEADER = 16


class ValidationStrips(Callback):
    """Writes validation/STAGE-STEP.png at each validation: one row per frame, the same frames every time.

    Each frame is the middle one of a clip's first window, for a few of the validation clips of the first
    process. The network is the one being validated: with EMA, the averaged weights.

    Args:
        folder: output_dir. stage: the stage being trained. data: its validation clips.
        earlier_steps: steps of the run's earlier stages.
    """

    def __init__(self, folder: Path, stage: Stage, data: TrainingData, earlier_steps: int):
        self.folder, self.stage, self.data = folder, stage, data
        self.earlier_steps = earlier_steps

    def on_validation_batch_start(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Render the frames before the first batch, with averaged weights in place and shards gathered.

        At the epoch's start it would be too early: callbacks run before the module gathers the shards.
        """
        del batch, dataloader_idx
        assert isinstance(pl_module, RendererModule)
        if batch_idx > 0 or not trainer.is_global_zero:
            return
        rows = list(self._rows(trainer, pl_module))
        if not rows:
            return
        strip = with_header(np.concatenate(rows), (*pl_module.renderer.config.guidance, "network", "truth"))
        step = trainer.global_step
        write_atomic(self.folder / "validation" / f"{self.stage.name}-{step:08d}.png", encode_png(strip))
        for logger in trainer.loggers:
            log_picture(logger, "validation", strip, self.earlier_steps + step)

    def _rows(self, trainer: lightning.Trainer, module: RendererModule) -> Iterator[np.ndarray]:
        for window in self.data.pictured_windows(self.stage):
            moved = {name: video.to(module.device) for name, video in window.items()}
            batch = trainer.precision_plugin.convert_input(moved)  # as Lightning does with every batch
            with torch.no_grad(), trainer.precision_plugin.forward_context():
                shown = module.renderer(batch)
            videos = [*(batch[name] for name in module.renderer.config.guidance), shown, batch[TARGET]]
            yield np.concatenate([_shown(video) for video in videos], 1)


def _shown(video: Tensor) -> np.ndarray:
    """Middle frame of (1, 3, K, H, W) in [-1, 1] as (h, w, 3) uint8, at most `WIDEST` pixels wide."""
    middle = video.shape[2] // 2
    frame = torch.from_numpy(to_display_array(video[:, :, middle : middle + 1])[0]).movedim(-1, 0)
    height, width = frame.shape[-2:]
    if width > WIDEST:
        frame = area_resized(frame, (WIDEST, max(1, round(height * WIDEST / width))))
    return (frame.movedim(0, -1).numpy() * 255).round().astype(np.uint8)


def with_header(picture: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Picture (H, W, 3) uint8 under a header line that names its columns, all of one width."""
    width = picture.shape[1] // len(names)
    header = Image.new("RGB", (picture.shape[1], HEADER))
    draw = ImageDraw.Draw(header)
    for number, name in enumerate(names):
        draw.text((number * width + 2, 2), name, fill="white", font=ImageFont.load_default(10))
    return np.concatenate([np.asarray(header), picture])
