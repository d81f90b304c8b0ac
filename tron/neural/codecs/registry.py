"""Codecs between pictures and latents, by their names in a renderer's configuration."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from torch import Tensor

from tron.neural.codecs.block_dct import BlockDCT
from tron.neural.protocols import Codec


def _wan(weights: str | Path | None) -> Codec:
    from tron.neural.codecs.wan import load_wan  # diffusers, which the shipped networks do without

    return load_wan(weights)


CODECS: dict[str, Callable[[str | Path | None], Codec]] = {
    "block_dct": lambda _weights: BlockDCT(),
    "wan": _wan,
    "pixels": lambda _weights: Pixels(),
}
"""Name -> function that makes the codec from the path of its weights, if it has any."""


class Pixels:
    """Identity: three channels, a latent frame for each frame, any number of frames and any size."""

    latent_channels = 3
    space_block = 1
    temporal_factor = 1

    def encode(self, video: Tensor) -> Tensor:
        """(B, 3, K, H, W), as it is."""
        return video

    def decode(self, latent: Tensor) -> Tensor:
        """(B, 3, K, H, W), as it is."""
        return latent

    def calibrate(self, videos: Iterable[Tensor]) -> None:
        """Nothing is fitted."""
