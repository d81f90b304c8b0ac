"""The codec that is none: the latents of a video are its pixels."""

from __future__ import annotations

from collections.abc import Iterable

from torch import Tensor


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
