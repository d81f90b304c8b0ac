"""The exact codec: a discrete cosine transform of blocks of pixels and frames, without weights.

The first frame stands alone; every further group of four frames becomes one latent frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor, nn

from tron.errors import TronError
from tron.neural.clips import TEMPORAL_FACTOR as TIME
from tron.neural.clips import check_frames

SPACE, COLORS = 4, 3
_SMALLEST_DEVIATION = 0.02  # of a channel: quieter ones would be blown up


def dct_matrix(n: int) -> Tensor:
    """The orthonormal DCT-II, (n, n) float64: row k is sqrt(2/n) cos(pi k (j + 1/2) / n), row 0 less."""
    k = torch.arange(n, dtype=torch.float64)
    basis = torch.cos(math.pi * (k[None] + 0.5) * k[:, None] / n) * math.sqrt(2 / n)
    basis[0] /= math.sqrt(2)
    return basis


class BlockDCT(nn.Module):
    """Lossless codec: the DCT of 4 x 4 pixels x 4 frames, 3 x 64 = 192 channels, normalised per channel.

    The first frame is repeated to fill its block and read back as the block's mean over time, so one frame
    uses the 48 channels without temporal frequency. `mean` and `deviation` (192,) are fitted on training
    clips and travel with the weights.
    """

    latent_channels = COLORS * SPACE * SPACE * TIME
    space_block = SPACE
    temporal_factor = TIME

    basis: Tensor
    mean: Tensor
    deviation: Tensor

    def __init__(self) -> None:
        super().__init__()
        space = dct_matrix(SPACE)
        basis = torch.kron(dct_matrix(TIME), torch.kron(space, space))  # (64, 64), orthonormal
        self.register_buffer("basis", basis.float(), persistent=False)
        self.register_buffer("mean", torch.zeros(self.latent_channels))
        self.register_buffer("deviation", torch.ones(self.latent_channels))

    def encode(self, video: Tensor) -> Tensor:
        """(B, 3, 1 + 4n, H, W) display values in [-1, 1] -> latents (B, 192, 1 + n, H / 4, W / 4).

        Raises TronError where the frames are not 1 + 4n or a side is no multiple of 4.
        """
        b, c, frames, height, width = video.shape
        check_frames(frames)
        if height % SPACE or width % SPACE:
            raise TronError(f"frames of {width} x {height} pixels", mend=f"pad to multiples of {SPACE}")
        video = torch.cat([video[:, :, :1].expand(-1, -1, TIME, -1, -1), video[:, :, 1:]], 2)
        blocks = video.reshape(b, c, -1, TIME, height // SPACE, SPACE, width // SPACE, SPACE)
        blocks = blocks.permute(0, 2, 4, 6, 1, 3, 5, 7).flatten(5)  # (B, n, h, w, 3, 64)
        latent = (blocks @ self.basis.T).flatten(4)
        latent = (latent - self.mean) / self.deviation
        return latent.permute(0, 4, 1, 2, 3)

    def decode(self, latent: Tensor) -> Tensor:
        """Latents (B, 192, 1 + n, h, w) -> video (B, 3, 1 + 4n, 4h, 4w); inverse of `encode`, not clamped."""
        latent = latent.permute(0, 2, 3, 4, 1) * self.deviation + self.mean
        blocks = latent.unflatten(4, (COLORS, -1)) @ self.basis
        blocks = blocks.unflatten(5, (TIME, SPACE, SPACE)).permute(0, 4, 1, 5, 2, 6, 3, 7)
        video = blocks.reshape(blocks.shape[0], COLORS, -1, blocks.shape[4] * SPACE, blocks.shape[6] * SPACE)
        return torch.cat([video[:, :, :TIME].mean(2, keepdim=True), video[:, :, TIME:]], 2)

    @torch.no_grad()
    def calibrate(self, videos: Iterable[Tensor]) -> None:
        """Set the normalisation from training videos, each (B, 3, K, H, W) in [-1, 1], in float64."""
        self.mean.zero_()
        self.deviation.fill_(1.0)
        count = 0
        total = torch.zeros(self.latent_channels, dtype=torch.float64)
        squares = torch.zeros_like(total)
        for video in videos:
            latent = self.encode(video).movedim(1, -1).reshape(-1, self.latent_channels).double()
            count += len(latent)
            total += latent.sum(0).cpu()
            squares += latent.square().sum(0).cpu()
        if count == 0:
            raise TronError("no frames to fit the codec's normalisation on")
        mean = total / count
        variance = (squares / count - mean.square()).clamp_min(0)
        self.mean.copy_(mean)
        # One frame alone has no temporal frequencies: their deviation of zero must not be divided by.
        self.deviation.copy_(variance.sqrt().clamp_min(_SMALLEST_DEVIATION))
