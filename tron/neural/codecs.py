"""Frozen codecs between video and latents: K = 1 + 4n frames to 1 + n latent frames, causally.

The first frame stands alone; every further group of four frames becomes one latent frame. `BlockDCT` is exact
and needs no weights; `WanCodec` wraps the WAN 2.1 VAE of the real weights and keeps the same rules.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from tron.errors import TronError
from tron.neural.windows import TIME, check_frames

SPACE, COLORS = 4, 3


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

    basis: Tensor
    mean: Tensor
    deviation: Tensor

    def __init__(self, smallest_deviation: float = 0.02):
        super().__init__()
        space = dct_matrix(SPACE)
        basis = torch.kron(dct_matrix(TIME), torch.kron(space, space))  # (64, 64), orthonormal
        self.register_buffer("basis", basis.float(), persistent=False)
        self.register_buffer("mean", torch.zeros(self.latent_channels))
        self.register_buffer("deviation", torch.ones(self.latent_channels))
        self.smallest_deviation = smallest_deviation

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
    def fit(self, videos: Iterable[Tensor]) -> None:
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
        self.deviation.copy_(variance.sqrt().clamp_min(self.smallest_deviation))


class WanCodec:
    """The WAN 2.1 VAE, frozen: 16 channels, 8 x 8 pixels x 4 frames, latents normalised by its own vectors.

    Not an nn.Module on purpose: neither EMA copies nor checkpoints should hold 127 M frozen parameters.
    `move_to` follows the network's device. Sizes are padded to 16 pixels, because the transformer's patches
    are 2 x 2 latents. Latents are the posterior's mode, never a sample; decoding is not clamped, since
    diffusers' own clamp kills gradients outside [-1, 1].
    """

    space_block = 16

    def __init__(self, vae: Any, checkpoint_decoder: bool = True):
        """vae: diffusers' AutoencoderKLWan; checkpoint_decoder: a second pass, 25 times less memory."""
        self.vae = vae.eval().requires_grad_(False)
        self.latent_channels = int(vae.config.z_dim)
        self.checkpoint_decoder = checkpoint_decoder
        self._mean = torch.tensor(vae.config.latents_mean).view(1, -1, 1, 1, 1)
        self._deviation = torch.tensor(vae.config.latents_std).view(1, -1, 1, 1, 1)

    def move_to(self, like: Tensor) -> None:
        """Bring the VAE to a tensor's device and floating type."""
        parameter = next(self.vae.parameters())
        if parameter.device != like.device or parameter.dtype != like.dtype:
            self.vae.to(like.device, like.dtype)
        self._mean = self._mean.to(like)
        self._deviation = self._deviation.to(like)

    def encode(self, video: Tensor) -> Tensor:
        """(B, 3, 1 + 4n, H, W) in [-1, 1] -> (B, 16, 1 + n, H / 8, W / 8); sides must be multiples of 16."""
        check_frames(video.shape[2])
        if video.shape[3] % self.space_block or video.shape[4] % self.space_block:
            raise TronError(
                f"frames of {video.shape[4]} x {video.shape[3]} pixels",
                mend=f"pad to multiples of {self.space_block}",
            )
        self.move_to(video)
        with torch.no_grad():
            return (self.vae.encode(video).latent_dist.mode() - self._mean) / self._deviation

    def decode(self, latent: Tensor) -> Tensor:
        """(B, 16, 1 + n, h, w) -> (B, 3, 1 + 4n, 8h, 8w), one latent frame at a time, not clamped."""
        self.move_to(latent)
        hidden = self.vae.post_quant_conv(latent * self._deviation + self._mean)
        self.vae.clear_cache()
        cache: list[Any] = list(self.vae._feat_map)
        chunks = []
        for index in range(hidden.shape[2]):
            chunk, cache = self._decode_chunk(hidden[:, :, index : index + 1], cache, index == 0)
            chunks.append(chunk)
        self.vae.clear_cache()
        return torch.cat(chunks, 2)

    def _decode_chunk(self, hidden: Tensor, cache: list[Any], first: bool) -> tuple[Tensor, list[Any]]:
        """Decode one latent frame; the feature cache goes in and out as values, so that it can be recomputed.

        Checkpointed chunks must see the cache of their own time again in the backward pass: diffusers'
        decoder updates it in place, hence the copy.
        """
        slots = [i for i, entry in enumerate(cache) if isinstance(entry, Tensor)]
        marks: dict[int, Any] = {}

        def run(hidden: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
            local = list(cache)
            for slot, tensor in zip(slots, tensors):
                local[slot] = tensor
            out = self.vae.decoder(hidden, feat_cache=local, feat_idx=[0], first_chunk=first)
            marks.update({i: e for i, e in enumerate(local) if not isinstance(e, Tensor)})
            return (out, *(entry for entry in local if isinstance(entry, Tensor)))

        given = [cache[slot] for slot in slots]
        if self.checkpoint_decoder and torch.is_grad_enabled() and hidden.requires_grad:
            out, *tensors = checkpoint(run, hidden, *given, use_reentrant=False)  # type: ignore[misc]
        else:
            out, *tensors = run(hidden, *given)
        remaining = iter(tensors)
        after = [marks[i] if i in marks else next(remaining) for i in range(len(cache))]
        return out, after
