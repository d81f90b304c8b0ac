"""The neural renderer: guidance buffers to the picture, by one pass through a transformer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from tron.errors import TronError
from tron.neural.backbone import Backbone
from tron.neural.codecs import CODECS
from tron.neural.configs import MEAN, RendererConfig
from tron.neural.protocols import Codec, Renderer
from tron.neural.windows import check_frames, windows

PLAIN_TIMESTEP = 0.2  # what the tiny transformer is told; any constant will do


class NeuralRenderer(Renderer):
    """Codec, transformer, codec. A new one with sigma None returns the buffer that `skip` names."""

    config: RendererConfig

    def __init__(self, config: RendererConfig | None = None, codec: Codec | None = None):
        """config: see RendererConfig; codec: made from the config unless it needs weights, then required."""
        super().__init__()
        self.config = config or RendererConfig()
        if self.config.codec not in CODECS:
            raise TronError(f"no codec is called {self.config.codec!r}", mend=f"they are {', '.join(CODECS)}")
        self.codec: Codec = codec if codec is not None else CODECS[self.config.codec](None)
        self.temporal_factor, self.space_block = self.codec.temporal_factor, self.codec.space_block
        check_frames(self.config.window, self.temporal_factor)
        channels = self.codec.latent_channels
        latents = len(self.config.guidance) if self.config.fusion == "concat" else 1
        self.backbone = Backbone(self.config.backbone, latents * channels, channels)

    def forward(self, buffers: Mapping[str, Tensor]) -> Tensor:
        """As Renderer.forward, with 1 + temporal_factor * n frames of any H and W.

        Sides are padded to the codec's block by repeating the edge, and cropped again. Raises TronError
        for another number of frames.
        """
        videos = self.stacked(buffers)
        check_frames(videos[0].shape[2], self.temporal_factor)
        height, width = videos[0].shape[-2:]
        latents = [self.codec.encode(self._padded(video)) for video in videos]
        mean = torch.stack(latents).mean(0)
        fused = torch.cat(latents, 1) if self.config.fusion == "concat" else mean
        skip = self.config.skip
        start = mean if skip == MEAN else latents[self.config.guidance.index(skip)]
        return self.codec.decode(self._denoise(fused, start))[..., :height, :width]

    def hidden_matrices(self) -> list[nn.Parameter]:
        """Weights between hidden layers, 2-D: attention and feed-forward of every block."""
        blocks = self.backbone.transformer.transformer_blocks
        return [p for name, p in blocks.named_parameters() if ".attn1.to_" in name or ".ff." in name]

    def calibrate(self, videos: Iterable[Tensor]) -> None:
        """Calibrate the codec."""
        self.codec.calibrate(videos)

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
    renderer: Renderer, displayed: Mapping[str, np.ndarray], window: int | None = None
) -> np.ndarray:
    """Render a clip of any length.

    Args:
        renderer: what renders.
        displayed: its guidance by name, (K, H, W, 3) display values in [0, 1], as `Clip.displayed` gives.
        window: frames a pass, 1 + temporal_factor * n (default: the renderer's own). The first pass gives
            all its frames; every later one, moved by one frame, the last of its frames.

    Returns:
        Display values (K, H, W, 3) in [0, 1], float32.
    """
    shapes = {buffer.shape for buffer in displayed.values()}
    if len(shapes) != 1 or any(len(shape) != 4 or shape[-1] != 3 or not shape[0] for shape in shapes):
        given = " and ".join(str(shape) for shape in sorted(shapes)) or "none"
        raise TronError(f"clip buffers of shapes {given}", mend="give (K, H, W, 3) alike")
    size = window or renderer.config.window
    check_frames(size, renderer.temporal_factor)
    device = next(renderer.parameters()).device
    buffers = {name: to_tensor(displayed[name]).to(device) for name in displayed}
    was_training = renderer.training
    renderer.eval()
    frames: list[np.ndarray] = []
    for indices in windows(next(iter(shapes))[0], size, renderer.temporal_factor):
        part = slice(indices[0], indices[-1] + 1)
        shown = to_display_array(renderer({name: video[:, :, part] for name, video in buffers.items()}))
        frames.extend(shown if not frames else shown[-1:])
    renderer.train(was_training)
    return np.stack(frames)
