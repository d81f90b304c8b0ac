"""The Lightning module: one renderer, its loss, AdamW and the schedule of the stage that is running."""

from __future__ import annotations

from typing import Any

import lightning
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from train.curriculum import Pace, Stage, learning_rate_factor
from tron.neural.losses import RendererLoss, psnr_per_frame


class OptimizerSettings(BaseModel):
    """AdamW and its schedule, the same in every stage."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    learning_rate: float = Field(default=1e-3, gt=0, description="Peak learning rate.")
    betas: tuple[float, float] = Field(default=(0.9, 0.99), description="AdamW's averaging rates.")
    weight_decay: float = Field(default=1e-2, ge=0, description="AdamW's decoupled weight decay.")
    warmup_steps: int = Field(default=50, ge=0, description="Steps of linear warm-up in each stage.")
    final_factor: float = Field(
        default=0.01, ge=0, le=1, description="Learning rate at a stage's end, as a fraction of its peak."
    )
    gradient_clip: float = Field(default=1.0, gt=0, description="Largest norm of the gradient.")
    ema_decay: float | None = Field(
        default=None,
        gt=0,
        lt=1,
        description="Decay of an exponential moving average of the weights; null: none.",
    )


class RendererModule(lightning.LightningModule):
    """Trains a renderer on {"pbr", "irr", "rgb"}, each (B, 3, K, H, W) display-encoded in [-1, 1]."""

    def __init__(self, renderer: nn.Module, loss: RendererLoss, optimizer: OptimizerSettings):
        super().__init__()
        self.renderer = renderer
        self.loss = loss
        self.settings = optimizer
        self.stage: Stage | None = None
        self.pace = Pace(1)

    def begin(self, stage: Stage, pace: Pace) -> None:
        """Choose the stage whose optimiser and schedule are made next."""
        self.stage, self.pace = stage, pace

    def training_step(self, batch: dict[str, Tensor], _index: int) -> Tensor:
        """The loss of one batch."""
        return self.loss(self.renderer(batch["pbr"], batch["irr"]), batch["rgb"])

    def validation_step(self, batch: dict[str, Tensor], _index: int) -> None:
        """PSNR of held-out windows, of the foreground and of the full frame, averaged over frames."""
        shown = self.renderer(batch["pbr"], batch["irr"])
        foreground = psnr_per_frame(shown, batch["rgb"], batch["mask"])
        full = psnr_per_frame(shown, batch["rgb"])
        size = full.numel()
        self.log("val_psnr", foreground.nanmean(), batch_size=size, sync_dist=True)
        self.log("val_psnr_full", full.mean(), batch_size=size, sync_dist=True)

    def configure_optimizers(self) -> Any:
        """AdamW over what is not frozen, with warm-up and a cosine over the stage."""
        if self.stage is None:
            raise RuntimeError("begin() chooses the stage first")
        settings = self.settings
        optimizer = torch.optim.AdamW(
            [parameter for parameter in self.renderer.parameters() if parameter.requires_grad],
            lr=settings.learning_rate * self.stage.learning_rate,
            betas=settings.betas,
            weight_decay=settings.weight_decay,
        )

        def factor(step: int) -> float:
            progress = self.pace.progress(step)
            return learning_rate_factor(progress, step, settings.warmup_steps, settings.final_factor)

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the stage's name and the seconds it has run."""
        checkpoint["tron_stage"] = self.stage.name if self.stage else ""
        checkpoint["tron_seconds"] = self.pace.seconds()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Go on counting a stage's time where it was left."""
        self.pace.spent = float(checkpoint["tron_seconds"])
