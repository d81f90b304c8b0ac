"""The Lightning module: a renderer, its loss, its optimiser and the schedule of the running stage."""

from __future__ import annotations

from typing import Any

import lightning
import torch
from torch import Tensor

from train.curriculum import Stage, StageClock, learning_rate_factor
from train.optimizers import make_optimizer
from train.settings import OptimizerSettings
from tron.neural.losses import RendererLoss, psnr_per_frame
from tron.neural.protocols import Renderer
from tron.shards.schema import TARGET


class RendererModule(lightning.LightningModule):
    """Trains a renderer on its guidance and the target, each (B, 3, K, H, W) display-encoded in [-1, 1]."""

    def __init__(self, renderer: Renderer, loss: RendererLoss, optimizer: OptimizerSettings):
        super().__init__()
        self.renderer = renderer
        self.loss = loss
        self.settings = optimizer
        self.stage: Stage | None = None
        self.clock = StageClock(1)
        self._psnr = torch.zeros(2, 2)

    def begin(self, stage: Stage, clock: StageClock) -> None:
        """Choose the stage whose optimiser and schedule are made next."""
        self.stage, self.clock = stage, clock

    def on_train_start(self) -> None:
        """Start the clock; set-up and loading are not counted."""
        self.clock.start()

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Read the clock for this step."""
        del optimizer
        self.clock.look()

    def on_train_batch_end(self, *_args: Any) -> None:
        """End the stage once its time limit is reached."""
        if self.clock.seconds_limit is not None and self.clock.progress(self.global_step) >= 1:
            self.trainer.should_stop = True

    def on_train_end(self) -> None:
        """Stop the clock."""
        self.clock.stop()

    def training_step(self, batch: dict[str, Tensor], _index: int) -> Tensor:
        """The loss of one batch."""
        return self.loss(self.renderer(batch), batch[TARGET])

    def validation_step(self, batch: dict[str, Tensor], _index: int) -> None:
        """Add up the PSNR of held-out windows, over the foreground and over the full frame."""
        shown = self.renderer(batch)
        for row, mask in enumerate((batch["mask"], None)):
            psnr = psnr_per_frame(shown, batch[TARGET], mask)
            psnr = psnr[~psnr.isnan()]  # frames without foreground
            self._psnr[row] += torch.stack([psnr.sum(), psnr.new_tensor(psnr.numel())])

    def on_validation_epoch_start(self) -> None:
        """Reset the sums."""
        self._psnr = torch.zeros(2, 2, device=self.device)

    def on_validation_epoch_end(self) -> None:
        """Log means over the frames of all processes, whose numbers of frames may differ."""
        sums, counts = self.trainer.strategy.reduce(self._psnr, reduce_op="sum").unbind(1)
        for name, total, count in zip(("val_psnr", "val_psnr_full"), sums, counts):
            if count > 0:
                # They are equal (sync_dist keeps Lightning from asking); train.callbacks tells the loggers.
                self.log(name, total / count, sync_dist=True, logger=False)

    def configure_optimizers(self) -> Any:
        """Make the stage's optimiser, with warm-up and cosine decay over the stage."""
        if self.stage is None:
            raise RuntimeError("begin() chooses the stage first")
        settings, stage = self.settings, self.stage
        optimizer = make_optimizer(self.renderer, settings)

        def factor(step: int) -> float:
            return learning_rate_factor(stage, self.clock.progress(step), step, settings.warmup_steps)

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the stage's name and the seconds it has run."""
        checkpoint["tron_stage"] = self.stage.name if self.stage else ""
        checkpoint["tron_seconds"] = self.clock.seconds()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Continue the stage's clock from the checkpoint's time."""
        self.clock.spent = self.clock.shown = float(checkpoint["tron_seconds"])
