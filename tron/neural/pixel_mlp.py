"""The strongest baseline without context: an MLP on each pixel's two colours."""

from __future__ import annotations

from itertools import pairwise

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from tron.errors import TronError


class PixelMLPConfig(BaseModel):
    """Width and number of hidden layers; it travels inside the weights file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    width: int = Field(default=64, ge=1)
    hidden_layers: int = Field(default=3, ge=1)
    window: int = Field(default=1, ge=1)


class PixelMLP(nn.Module):
    """1 x 1 convolutions on the two buffers (facts 9), with the residual taken from the PBR buffer.

    What it cannot do, since it sees one pixel, is what a neural renderer is for: reflections and bounce
    light from elsewhere. It trains through the same tron-train as the renderer.
    """

    def __init__(self, config: PixelMLPConfig | None = None):
        super().__init__()
        self.config = config or PixelMLPConfig()
        sizes = [6] + [self.config.width] * self.config.hidden_layers
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(sizes):
            layers += [nn.Linear(inputs, outputs), nn.GELU()]
        last = nn.Linear(sizes[-1], 3)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(*layers, last)

    def forward(self, pbr: Tensor, irradiance: Tensor) -> Tensor:
        """Both (B, 3, K, H, W), display-encoded in [-1, 1] -> the same shape, not clamped."""
        if pbr.shape != irradiance.shape or pbr.ndim != 5 or pbr.shape[1] != 3:
            raise TronError(f"buffers of shapes {tuple(pbr.shape)} and {tuple(irradiance.shape)}")
        # A linear layer over the last axis is a 1 x 1 convolution, and much faster on a CPU.
        pixels = torch.cat([pbr, irradiance], 1).movedim(1, -1)
        return pbr + self.layers(pixels).movedim(-1, 1)

    def hidden_matrices(self) -> list[nn.Parameter]:
        """Weights between hidden layers, 2-D."""
        return [parameter for parameter in self.layers.parameters() if parameter.ndim == 2][1:-1]
