"""Guidance of a clip for methods, and the pixels to judge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import Any, Literal

import numpy as np

from tron.cameras import Camera
from tron.flow import surface_motion
from tron.neural.clips import Motion
from tron.shards.moving import Moving
from tron.shards.schema import TARGET, Clip, displayed, guidance_members

Region = Literal["foreground", "frame", "metal", "rest"]
REGIONS: tuple[Region, Region] = ("foreground", "frame")
MATERIALS: tuple[Region, Region] = ("metal", "rest")
"""Parts of the foreground: where the surfels are metallic by more than a half, and where they are not."""
MEMBERS = (*guidance_members(), TARGET, "mask", "foreground")
"""Members of a clip that predictions and their scores need."""
SURFELS_DEPTH = "depth"
"""Member that motion is known by where a clip is rendered: the surfels', not the truth's."""
PAIRS = 64
"""Pairs of frames whose match is remembered."""


@dataclass(frozen=True)
class Buffers:
    """Members of a clip at some pixels, by name.

    Attributes:
        images: (..., C) float32 each, linear, as stored.
        exposure: factor before the tone curve.
        motion: of the surfaces of a whole clip, from cameras and the depth of the surfels, which whoever
            renders it has, and of the object that moves; None where that depth was not read.
    """

    images: Mapping[str, np.ndarray]
    exposure: float
    motion: Motion | None = None
    _displayed: dict[str, np.ndarray] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, clip: Clip) -> Buffers:
        """All pixels of a clip: (K, H, W, C)."""
        motion = _motion(clip) if SURFELS_DEPTH in clip.frames else None
        return cls(clip.frames, clip.meta.exposure, motion)

    def at(self, pixels: Any) -> Buffers:
        """Some pixels, (n, C); ``pixels`` index all axes but the last."""
        return Buffers({name: image[pixels] for name, image in self.images.items()}, self.exposure)

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a member, linear."""
        return self.images[name]

    def displayed(self, name: str) -> np.ndarray:
        """Return a member in display values: (..., 3) in [0, 1], computed once."""
        if name not in self._displayed:
            self._displayed[name] = displayed(name, self[name], self.exposure)
        return self._displayed[name]


def _motion(clip: Clip) -> Motion:
    """Return the motion of a clip's surfaces; its metadata are read at the first match."""

    @cache
    def known() -> Motion:
        cameras = [Camera.from_dict(each) for each in clip.meta.cameras]
        moving = Moving.of(clip.meta)
        return surface_motion(
            cameras,
            clip.frames[SURFELS_DEPTH].__getitem__,
            None if moving is None else moving.between,
            still_sky=not clip.meta.extra.get("turn_deg"),
        )

    # Several methods and ways of overlapping ask for the same.
    return lru_cache(PAIRS)(lambda index, other: known()(index, other))


def region_mask(clip: Clip, region: Region) -> np.ndarray:
    """Return pixels of a region, (K, H, W) bool: true foreground, its metals, its other materials, or all."""
    foreground = clip.frames["foreground"][..., 0] > 0.5
    if region == "frame":
        return np.ones_like(foreground)
    if region == "foreground":
        return foreground
    metal = clip.frames["surface"][..., 2] > 0.5
    return foreground & (metal if region == "metal" else ~metal)
