"""Protocols of the two exchangeable parts: the renderer, and the codec inside it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Protocol

from torch import Tensor, nn

from tron.errors import TronError
from tron.neural.configs import GuidedConfig


class Codec(Protocol):
    """Encodes video to latents and back, causally: the first frame is encoded alone.

    Attributes:
        latent_channels: C of a latent.
        space_block: pixels that both sides of a frame must be multiples of.
        temporal_factor: frames of each latent frame after the first.
    """

    latent_channels: int
    space_block: int
    temporal_factor: int

    def encode(self, video: Tensor) -> Tensor:
        """(B, 3, K, H, W) in [-1, 1] -> (B, C, 1 + (K - 1) / temporal_factor, h, w)."""
        ...

    def decode(self, latent: Tensor) -> Tensor:
        """Latents -> (B, 3, K, H, W), not clamped."""
        ...

    def calibrate(self, videos: Iterable[Tensor]) -> None:
        """Fit what is fitted before training, to videos (B, 3, K, H, W) in [-1, 1]."""
        ...


class Renderer(nn.Module):
    """A network that draws the picture from guidance.

    One of your own defines `config`, whose type is the class of its settings, and `forward`; the rest has
    defaults. It is made from its settings alone: `MyNetwork(config)`.

    Attributes:
        config: `guidance` names the buffers it is given, `window` the frames of a clip it draws at once.
        temporal_factor: it takes 1 + temporal_factor * n frames.
    """

    config: GuidedConfig
    temporal_factor: int = 1
    space_block: int = 1
    """Pixels that both sides of a training crop must be multiples of; `forward` itself pads other frames."""

    @property
    def reach(self) -> int | None:
        """Receptive field: pixels around a pixel on which it noticeably depends; None: the whole picture."""
        return None

    @property
    def stride(self) -> int:
        """Tile step in pixels: a part that starts at a multiple is drawn as in the whole picture."""
        return self.space_block

    def forward(self, buffers: Mapping[str, Tensor], weights: Mapping[str, float] | None = None) -> Tensor:
        """Guidance by name, each (B, 3, K, H, W) display-encoded in [-1, 1] -> the same shape, not clamped.

        weights: of the buffers' latents by name, instead of the configuration's; a renderer without latents
        refuses them. Buffers that `config.guidance` does not name are left alone. Raises TronError where one
        of those is missing, shapes differ, or weights do not fit.
        """
        raise NotImplementedError

    def check_weights(self, weights: Mapping[str, float] | None) -> None:
        """Raise TronError unless `forward` accepts these weights; None is always accepted."""
        if weights is not None:
            raise TronError(f"a {type(self).__name__} has no latents to weigh", mend="leave weights out")

    def hidden_matrices(self) -> list[nn.Parameter]:
        """Return 2-D weights between hidden layers that Muon may optimise; none here, so AdamW takes all."""
        return []

    def temporal_weights(self) -> dict[str, nn.Parameter]:
        """Return parameters of the layers between frames, by name, which initially add zero; here none."""
        return {}

    def calibrate(self, videos: Iterable[Tensor]) -> None:
        """Fit what is fitted before training, to videos (B, 3, K, H, W) in [-1, 1]; here nothing."""

    def stacked(self, buffers: Mapping[str, Tensor]) -> list[Tensor]:
        """Return the buffers of `config.guidance`, in order, after checking them."""
        if missing := [name for name in self.config.guidance if name not in buffers]:
            raise TronError(f"the renderer needs the buffer '{missing[0]}'", mend="give all its guidance")
        videos = [buffers[name] for name in self.config.guidance]
        shape = videos[0].shape
        if len(shape) != 5 or shape[1] != 3 or any(video.shape != shape for video in videos):
            raise TronError(f"buffers of shapes {', '.join(str(tuple(video.shape)) for video in videos)}")
        return videos
