"""Guidance of a clip as methods see it, and the pixels on which they are judged."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from tron.color import to_display
from tron.shards.schema import Clip

Region = Literal["foreground", "frame"]
REGIONS: tuple[Region, Region] = ("foreground", "frame")
MEMBERS = ("pbr", "irradiance", "rgb", "unshadowed", "shadowed", "mask", "foreground")
"""Members of a clip that predictions and their scores need."""


@dataclass(frozen=True)
class Buffers:
    """Guidance of any pixels, linear float32.

    Attributes:
        pbr: (..., 3) split-sum radiance without shadows.
        irradiance: (..., 3) over pi, with shadows.
        unshadowed: (..., 3) irradiance over pi without visibility.
        shadowed: (..., 3) base color (1 - metallic) irradiance + split-sum specular.
        opacity: (..., 1) of the surfels, [0, 1].
        exposure: the clip's factor before the tone curve.
    """

    pbr: np.ndarray
    irradiance: np.ndarray
    unshadowed: np.ndarray
    shadowed: np.ndarray
    opacity: np.ndarray
    exposure: float
    _displayed: dict[str, np.ndarray] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, clip: Clip) -> Buffers:
        """The buffers of all frames of a clip: (K, H, W, C)."""
        members = ("pbr", "irradiance", "unshadowed", "shadowed", "mask")
        return cls(*(clip.frames[name] for name in members), exposure=clip.meta.exposure)

    def at(self, pixels: Any) -> Buffers:
        """Some pixels, (n, C); ``pixels`` index all axes but the last."""
        images = (self.pbr, self.irradiance, self.unshadowed, self.shadowed, self.opacity)
        return Buffers(*(image[pixels] for image in images), exposure=self.exposure)

    def displayed(self, name: str) -> np.ndarray:
        """One of the buffers as displayed: (..., 3) in [0, 1], computed once."""
        if name not in self._displayed:
            self._displayed[name] = to_display(getattr(self, name), self.exposure)
        return self._displayed[name]


def displayed_truth(clip: Clip) -> np.ndarray:
    """The clip's rgb as displayed, (K, H, W, 3) in [0, 1]; captured photos are display-referred already."""
    rgb = clip.frames["rgb"]
    if clip.meta.color_space.get("rgb", "linear") == "display":
        return rgb
    return to_display(rgb, clip.meta.exposure)


def region_mask(clip: Clip, region: Region) -> np.ndarray:
    """Pixels of a region, (K, H, W) bool: the ground-truth foreground, or the whole frame."""
    foreground = clip.frames["foreground"][..., 0] > 0.5
    return foreground if region == "foreground" else np.ones_like(foreground)
