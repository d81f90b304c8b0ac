"""The neural renderer: PBR and irradiance buffers to the picture, by one pass through a transformer."""

from __future__ import annotations

from typing import Any, Literal, Protocol

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn
from torch.nn.functional import pad

from tron.color import to_display
from tron.errors import TronError
from tron.neural.backbone import Backbone, BackboneConfig
from tron.neural.codecs import BlockDCT
from tron.neural.windows import check_frames, windows


class Codec(Protocol):
    """Video to latents and back, see tron.neural.codecs."""

    latent_channels: int
    space_block: int

    def encode(self, video: Tensor) -> Tensor:
        """(B, 3, 1 + 4n, H, W) -> (B, C, 1 + n, h, w)."""
        ...

    def decode(self, latent: Tensor) -> Tensor:
        """(B, C, 1 + n, h, w) -> (B, 3, 1 + 4n, H, W)."""
        ...


class RendererConfig(BaseModel):
    """What a renderer is made of; it travels inside the weights file.

    fusion: "concat" gives the transformer both latents; "average" their mean, which keeps the input width
    that
        published weights expect (the paper's choice, 3 dB worse for the tiny model).
    skip: which latent the network's output is added to: that of the PBR buffer, or the mean of both.
    sigma: noise level of the single denoising step (paper: 250 of 1000, i.e. 0.25), t = sigma / (1 + sigma);
        input (1 - t) z, result (1 - t) z - t net(...). None, the tiny default, is the plain residual z +
        net(z).
    window: frames that `render_clip` hands over at once, 1 + 4n.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    codec: Literal["block_dct", "wan"] = "block_dct"
    fusion: Literal["concat", "average"] = "concat"
    skip: Literal["pbr", "mean"] = "pbr"
    sigma: float | None = Field(default=None, gt=0)
    window: int = Field(default=1, ge=1)
    backbone: BackboneConfig = BackboneConfig()


PLAIN_TIMESTEP = 0.2  # what the tiny transformer is told; any constant will do


class NeuralRenderer(nn.Module):
    """Codec, transformer, codec. Freshly made with sigma None it returns the PBR buffer unchanged."""

    def __init__(self, config: RendererConfig | None = None, codec: Codec | None = None):
        """config: see RendererConfig; codec: made from the config unless it needs weights, then required."""
        super().__init__()
        self.config = config or RendererConfig()
        check_frames(self.config.window)
        if codec is None and self.config.codec != "block_dct":
            raise TronError("this renderer needs the WAN VAE's weights", mend="give a codec")
        self.codec: Any = codec if codec is not None else BlockDCT()
        channels = self.codec.latent_channels
        inputs = 2 * channels if self.config.fusion == "concat" else channels
        self.backbone = Backbone(self.config.backbone, inputs, channels)

    def forward(self, pbr: Tensor, irradiance: Tensor) -> Tensor:
        """Both (B, 3, 1 + 4n, H, W), display-encoded in [-1, 1], any H and W -> the same shape, not clamped.

        Sides are padded to the codec's block by repeating the edge, and cropped again. Raises TronError
        where the buffers differ in shape or the number of frames is not 1 + 4n.
        """
        if pbr.shape != irradiance.shape or pbr.ndim != 5 or pbr.shape[1] != 3:
            raise TronError(f"buffers of shapes {tuple(pbr.shape)} and {tuple(irradiance.shape)}")
        check_frames(pbr.shape[2])
        height, width = pbr.shape[-2:]
        pbr, irradiance = (self._padded(buffer) for buffer in (pbr, irradiance))
        z_pbr, z_irradiance = self.codec.encode(pbr), self.codec.encode(irradiance)
        mean = 0.5 * (z_pbr + z_irradiance)
        fused = torch.cat([z_pbr, z_irradiance], 1) if self.config.fusion == "concat" else mean
        start = z_pbr if self.config.skip == "pbr" else mean
        return self.codec.decode(self._denoise(fused, start))[..., :height, :width]

    def hidden_matrices(self) -> list[nn.Parameter]:
        """Weights between hidden layers, 2-D: attention and feed-forward of every block."""
        blocks = self.backbone.transformer.transformer_blocks
        return [p for name, p in blocks.named_parameters() if ".attn1.to_" in name or ".ff." in name]

    def _denoise(self, fused: Tensor, start: Tensor) -> Tensor:
        if self.config.sigma is None:
            return start + self.backbone(fused, PLAIN_TIMESTEP)
        t = self.config.sigma / (1 + self.config.sigma)
        # The difference of two nearly equal numbers in bf16 would lose the picture: float32 here.
        return (1 - t) * start.float() - t * self.backbone((1 - t) * fused, t).float()

    def _padded(self, video: Tensor) -> Tensor:
        block = self.codec.space_block
        below, right = -video.shape[-2] % block, -video.shape[-1] % block
        return pad(video, (0, right, 0, below, 0, 0), mode="replicate") if below or right else video


def to_tensor(display: np.ndarray) -> Tensor:
    """Display values (K, H, W, 3) in [0, 1] -> network input (1, 3, K, H, W) in [-1, 1]."""
    video = torch.from_numpy(np.ascontiguousarray(display, np.float32))
    return video.permute(3, 0, 1, 2)[None] * 2 - 1


def to_display_array(video: Tensor) -> np.ndarray:
    """Network output (1, 3, K, H, W) -> display values (K, H, W, 3) in [0, 1], clipped, NumPy float32."""
    image = (video[0].float().clamp(-1, 1) + 1) / 2
    return np.ascontiguousarray(image.permute(1, 2, 3, 0).cpu().numpy())


@torch.no_grad()
def render_clip(
    renderer: nn.Module,
    pbr: np.ndarray,
    irradiance: np.ndarray,
    exposure: float,
    window: int | None = None,
) -> np.ndarray:
    """Render a clip of any length.

    Args:
        renderer: NeuralRenderer, PixelMLP or another module with their forward.
        pbr, irradiance: (K, H, W, 3) linear, as the guidance gives them.
        exposure: the light's exposure, applied before AgX.
        window: frames a pass, 1 + 4n (default: the renderer's own). The first pass gives all its frames,
        every
            later one, moved by one frame, the last of its frames.

    Returns:
        Display values (K, H, W, 3) in [0, 1], float32.
    """
    if pbr.shape != irradiance.shape or pbr.ndim != 4 or pbr.shape[-1] != 3 or not len(pbr):
        raise TronError(
            f"clip buffers of shapes {pbr.shape} and {irradiance.shape}", mend="give (K, H, W, 3)"
        )
    size = window or getattr(getattr(renderer, "config", None), "window", 1)
    check_frames(size)
    device = next(renderer.parameters()).device
    pbr_display, irradiance_display = (
        to_tensor(to_display(np.asarray(buffer, np.float32), exposure)).to(device)
        for buffer in (pbr, irradiance)
    )
    was_training = renderer.training
    renderer.eval()
    frames: list[np.ndarray] = []
    for indices in windows(len(pbr), size):
        part = slice(indices[0], indices[-1] + 1)
        shown = to_display_array(renderer(pbr_display[:, :, part], irradiance_display[:, :, part]))
        frames.extend(shown if not frames else shown[-1:])
    renderer.train(was_training)
    return np.stack(frames)
