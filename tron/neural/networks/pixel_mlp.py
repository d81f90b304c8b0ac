"""The strongest baseline without context: an MLP on the colours of each pixel."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import torch
from torch import Tensor, nn

from tron.neural.configs import PixelMLPConfig
from tron.neural.protocols import Renderer


class PixelMLP(Renderer):
    """1 x 1 convolutions on the guidance (conventions.md, 12), added to the buffer that `skip` names.

    What it cannot do, since it sees one pixel, is what a neural renderer is for: reflections and bounce
    light from elsewhere. It trains through the same tron-train as the renderer.
    """

    config: PixelMLPConfig

    def __init__(self, config: PixelMLPConfig | None = None):
        super().__init__()
        self.config = config or PixelMLPConfig()
        sizes = [3 * len(self.config.guidance)] + [self.config.width] * self.config.hidden_layers
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(sizes):
            layers += [nn.Linear(inputs, outputs), nn.GELU()]
        last = nn.Linear(sizes[-1], 3)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(*layers, last)

    @property
    def reach(self) -> int:
        """As Renderer.reach: none."""
        return 0

    def forward(self, buffers: Mapping[str, Tensor], weights: Mapping[str, float] | None = None) -> Tensor:
        """As Renderer.forward."""
        self.check_weights(weights)
        # A linear layer over the last axis is a 1 x 1 convolution, and much faster on a CPU.
        pixels = torch.cat(self.stacked(buffers), 1).movedim(1, -1)
        return buffers[self.config.skip] + self.layers(pixels).movedim(-1, 1)

    def hidden_matrices(self) -> list[nn.Parameter]:
        """Weights between hidden layers, 2-D."""
        return [parameter for parameter in self.layers.parameters() if parameter.ndim == 2][1:-1]
