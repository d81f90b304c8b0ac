"""A small convolutional U-Net between the latents, modelled on NAFNet, with layers between frames.

A block follows Chen et al., "Simple Baselines for Image Restoration" (2022): a normalisation over channels, a
widening, a 3 x 3 convolution, a product of two halves instead of an activation (SimpleGate), a projection;
then the same without the convolution. What both add is scaled by learned factors that begin at zero.

Tensors are (N, h, w, C) inside, frames in N = B T: 1 x 1 convolutions are then plain matrix products, and
3 x 3 ones see the channels_last layout, which a CPU computes fastest (docs/concepts/network.md).
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from tron.neural.configs import UNetConfig


class UNet(nn.Module):
    """Predict a correction to latents of any size; an untrained network returns zeros."""

    def __init__(self, config: UNetConfig, in_channels: int, out_channels: int):
        super().__init__()
        self.config = config
        widths, area = config.widths, config.patch**2
        self.embed = nn.Linear(in_channels * area, widths[0])
        self.down = nn.ModuleList(_Level(config, *each) for each in zip(widths, config.blocks))
        self.up = nn.ModuleList(_Level(config, *each) for each in zip(widths, config.blocks_up))
        self.shrink = nn.ModuleList(nn.Linear(4 * fine, coarse) for fine, coarse in pairwise(widths))
        self.grow = nn.ModuleList(nn.Linear(coarse, 4 * fine) for fine, coarse in pairwise(widths))
        # 3 x 3, since pixels of neighbouring patches would otherwise not know of each other.
        self.out = nn.Conv2d(widths[0], out_channels * area, 3, padding=1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)  # type: ignore[arg-type]

    @property
    def stride(self) -> int:
        """Number of latent pixels to whose multiples sides are padded."""
        return self.config.patch * 2 ** (len(self.config.widths) - 1)

    def forward(self, latent: Tensor, timestep: float = 0.0) -> Tensor:
        """(B, in_channels, T, h, w) -> (B, out_channels, T, h, w), any T, h and w.

        Sides are padded to the stride by repeating the edge, and cropped again. There is one noise level at
        most, so the timestep tells nothing.
        """
        del timestep
        frames, height, width = latent.shape[2:]
        x = latent.movedim(2, 1).flatten(0, 1)  # (B T, C, h, w)
        below, right = -height % self.stride, -width % self.stride
        if below or right:
            x = pad(x, (0, right, 0, below), mode="replicate")
        x = self.embed(_gathered(x.permute(0, 2, 3, 1), self.config.patch))
        skipped = []
        for level, shrink in zip(self.down, self.shrink):
            x = level(x, frames)
            skipped.append(x)
            x = shrink(_gathered(x, 2))
        x = self.down[-1](x, frames)
        for level, grow, fine in reversed(list(zip(self.up, self.grow, skipped))):
            x = level(fine + _spread(grow(x), 2), frames)
        x = _spread(_convolved(self.out, x), self.config.patch)[:, :height, :width]
        return x.unflatten(0, (-1, frames)).permute(0, 4, 1, 2, 3)

    def hidden_matrices(self) -> list[nn.Parameter]:
        """Weights between hidden layers, 2-D: all matrices but the embedding."""
        return [p for name, p in self.named_parameters() if p.ndim == 2 and not name.startswith("embed")]

    def temporal_weights(self) -> dict[str, nn.Parameter]:
        """Return the parameters of the layers between frames, by name."""
        return {name: p for name, p in self.named_parameters() if ".between_frames." in name}


class _Level(nn.Module):
    """Blocks at one resolution, and the path between its frames."""

    def __init__(self, config: UNetConfig, width: int, blocks: int):
        super().__init__()
        self.blocks = nn.Sequential(*(_Block(config, width) for _ in range(blocks)))
        self.between_frames = _TimeMixer(width) if config.temporal else None

    def forward(self, x: Tensor, frames: int) -> Tensor:
        """(B T, h, w, C) -> the same; frames: T."""
        x = self.blocks(x)
        if self.between_frames is None:
            return x
        return self.between_frames(x, frames) if frames > 1 else self.between_frames.idle(x)


class _Block(nn.Module):
    """A convolution and a mixing of channels, each gated, scaled and added."""

    def __init__(self, config: UNetConfig, width: int):
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        if config.spatial == "depthwise":
            self.widen1 = nn.Linear(width, 2 * width)
            self.spatial = nn.Conv2d(2 * width, 2 * width, 3, padding=1, groups=2 * width)
        else:
            self.widen1 = nn.Identity()
            self.spatial = nn.Conv2d(width, 2 * width, 3, padding=1)
        self.attend = nn.Linear(width, width) if config.attention else None
        self.project1 = nn.Linear(width, width)
        self.widen2, self.project2 = nn.Linear(width, 2 * width), nn.Linear(width, width)
        self.scale1, self.scale2 = nn.Parameter(torch.zeros(width)), nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        """(N, h, w, C) -> the same."""
        y = _gated(_convolved(self.spatial, self.widen1(self.norm1(x))))
        if self.attend is not None:
            y = y * self.attend(y.mean((1, 2), keepdim=True))
        x = x + self.scale1 * self.project1(y)
        return x + self.scale2 * self.project2(_gated(self.widen2(self.norm2(x))))


class _TimeMixer(nn.Module):
    """A block whose convolution is 3 x 3 pixels x 3 frames; a new one adds nothing.

    The product of two halves can compare a frame with its neighbours. Frames before the first and after the
    last count as zeros.
    """

    def __init__(self, width: int):
        super().__init__()
        self.norm, self.widen = nn.LayerNorm(width), nn.Linear(width, 2 * width)
        # Each channel's view of the frame after, its own, and the one before: 2-D, which CPUs do fast.
        self.spatial = nn.Conv2d(2 * width, 6 * width, 3, padding=1, groups=2 * width)
        self.project = nn.Linear(width, width)
        nn.init.zeros_(self.project.weight)
        nn.init.zeros_(self.project.bias)

    def forward(self, x: Tensor, frames: int) -> Tensor:
        """(B T, h, w, C) -> the same."""
        views = _convolved(self.spatial, self.widen(self.norm(x)))
        views = views.unflatten(0, (-1, frames)).unflatten(-1, (-1, 3))  # (B, T, h, w, 2C, 3)
        for_next, own, for_last = views.unbind(-1)
        nothing = torch.zeros_like(own[:, :1])
        y = own + torch.cat([nothing, for_next[:, :-1]], 1) + torch.cat([for_last[:, 1:], nothing], 1)
        return x + self.project(_gated(y.flatten(0, 1)))

    def idle(self, x: Tensor) -> Tensor:
        """The same values, with a gradient of zero for the weights of a path that has nowhere to lead.

        Distributed training waits for a gradient of every weight that is not frozen.
        """
        trained = [p for p in self.parameters() if p.requires_grad]
        if not trained or not torch.is_grad_enabled():
            return x
        return x + 0 * torch.stack([p.sum() for p in trained]).sum()


def _convolved(layer: nn.Conv2d, x: Tensor) -> Tensor:
    """A convolution of (N, h, w, C)."""
    return layer(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


def _gated(x: Tensor) -> Tensor:
    """SimpleGate: (..., 2C) -> (..., C), the product of both halves."""
    first, second = x.chunk(2, -1)
    return first * second


def _gathered(x: Tensor, side: int) -> Tensor:
    """(N, h, w, C) -> (N, h / side, w / side, side^2 C)."""
    x = x.unflatten(2, (-1, side)).unflatten(1, (-1, side))  # (N, h', side, w', side, C)
    return x.transpose(2, 3).flatten(3)


def _spread(x: Tensor, side: int) -> Tensor:
    """(N, h, w, side^2 C) -> (N, side h, side w, C); undoes `_gathered`."""
    x = x.unflatten(3, (side, side, -1))  # (N, h, w, side, side, C)
    return x.transpose(2, 3).flatten(1, 2).flatten(2, 3)
