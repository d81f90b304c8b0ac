"""The codec for the published weights: the frozen WAN 2.1 VAE, read from a local file."""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from diffusers.loaders.single_file_utils import convert_wan_vae_to_diffusers
from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from tron.errors import TronError
from tron.neural.clips import TEMPORAL_FACTOR, check_frames
from tron.neural.codecs.published_files import existing, folder_state, load_strictly, torch_state

WAN_FILE = "tokenizer/tokenizer.pth of the same repository (or a diffusers folder `vae` of WAN 2.1)"


class WanCodec:
    """The WAN 2.1 VAE, frozen: 16 channels, 8 x 8 pixels x 4 frames, latents normalised by its own vectors.

    Not an nn.Module on purpose: neither EMA copies nor checkpoints should hold 127 M frozen parameters.
    `move_to` follows the network's device. Sizes are padded to 16 pixels, because the transformer's patches
    are 2 x 2 latents. Latents are the posterior's mode, never a sample; decoding is not clamped, since
    diffusers' own clamp kills gradients outside [-1, 1].
    """

    space_block = 16
    temporal_factor = TEMPORAL_FACTOR

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
        """(B, 3, 1 + 4n, H, W) in [-1, 1] -> (B, 16, 1 + n, H / 8, W / 8); sides must be multiples of 16.

        Without gradients, which training never asks for, and one latent frame at a time: what a frame needs
        of those before it is in the feature cache, so that the memory hardly grows with the frames.
        """
        check_frames(video.shape[2])
        if video.shape[3] % self.space_block or video.shape[4] % self.space_block:
            raise TronError(
                f"frames of {video.shape[4]} x {video.shape[3]} pixels",
                mend=f"pad to multiples of {self.space_block}",
            )
        self.move_to(video)
        with torch.no_grad():
            cache: list[Any] = [None] * self.vae._cached_conv_counts["encoder"]
            parts = [
                self.vae.encoder(video[:, :, start:stop], feat_cache=cache, feat_idx=[0])
                for start, stop in self._chunks(video.shape[2])
            ]
            moments = self.vae.quant_conv(torch.cat(parts, 2))
            return (moments[:, : self.latent_channels] - self._mean) / self._deviation

    def decode(self, latent: Tensor) -> Tensor:
        """(B, 16, 1 + n, h, w) -> (B, 3, 1 + 4n, 8h, 8w), one latent frame at a time, not clamped."""
        self.move_to(latent)
        hidden = self.vae.post_quant_conv(latent * self._deviation + self._mean)
        cache: list[Any] = [None] * self.vae._cached_conv_counts["decoder"]
        chunks = []
        for index in range(hidden.shape[2]):
            chunk, cache = self._decode_chunk(hidden[:, :, index : index + 1], cache, index == 0)
            chunks.append(chunk)
        return torch.cat(chunks, 2)

    def calibrate(self, videos: Iterable[Tensor]) -> None:
        """Fit nothing: the VAE has its own normalisation."""

    def _chunks(self, frames: int) -> list[tuple[int, int]]:
        """Frames [start, stop) behind each latent frame: the first alone, then four and four."""
        edges = range(1, frames + 1, self.temporal_factor)
        return [(0, 1), *pairwise(edges)]

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


def load_wan(path: str | Path | None, **structure: Any) -> WanCodec:
    """The WAN 2.1 VAE from raw `tokenizer.pth` or a diffusers folder; `structure`: diffusers' arguments."""
    found = existing(path, "the WAN 2.1 VAE", WAN_FILE)
    if found.is_dir():
        config = found / "config.json"
        if config.is_file() and not structure:
            names = json.loads(config.read_text())
            structure = {key: value for key, value in names.items() if not key.startswith("_")}
        state = folder_state(found)
    else:
        raw = torch_state(found)
        try:
            state = convert_wan_vae_to_diffusers(raw)
        except (KeyError, RuntimeError, ValueError) as error:
            raise TronError(f"not a WAN 2.1 VAE: {error}", str(found), f"give {WAN_FILE}") from error
    with torch.device("meta"):
        vae = AutoencoderKLWan(**structure)
    load_strictly(vae, {name: tensor.float() for name, tensor in state.items()}, found)
    return WanCodec(vae)
