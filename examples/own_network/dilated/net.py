"""Dilated convolutions over the guidance, added to `lit`."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from pydantic import Field
from torch import Tensor, nn

from tron.neural.configs import GuidedConfig
from tron.neural.protocols import Renderer


class DilatedConfig(GuidedConfig):
    """Settings of Dilated; guidance, skip and window are there already."""

    guidance: tuple[str, ...] = ("lit", "albedo")
    width: int = Field(default=16, ge=1, description="Channels of each layer.")
    dilations: tuple[int, ...] = Field(default=(1, 2, 4, 8), description="Of each layer.")


class Dilated(Renderer):
    """3 x 3 convolutions whose pixels lie ever further apart. Each frame is drawn by itself."""

    config: DilatedConfig

    def __init__(self, config: DilatedConfig | None = None):
        super().__init__()
        self.config = config or DilatedConfig()
        channels = 3 * len(self.config.guidance)
        layers: list[nn.Module] = []
        for dilation in self.config.dilations:
            layers += [
                nn.Conv2d(channels, self.config.width, 3, padding="same", dilation=dilation),
                nn.GELU(),
            ]
            channels = self.config.width
        last = nn.Conv2d(channels, 3, 1, bias=False)
        nn.init.zeros_(last.weight)  # a new network draws `lit` as it is
        self.layers = nn.Sequential(*layers, last)

    def forward(self, buffers: Mapping[str, Tensor], weights: Mapping[str, float] | None = None) -> Tensor:
        """Guidance by name, each (B, 3, K, H, W) in [-1, 1], to the picture of that shape."""
        self.check_weights(weights)
        given = torch.cat(self.stacked(buffers), 1)
        batch, _, frames, height, width = given.shape
        each = given.transpose(1, 2).reshape(batch * frames, -1, height, width)
        change = self.layers(each).reshape(batch, frames, 3, height, width).transpose(1, 2)
        return buffers[self.config.skip] + change
