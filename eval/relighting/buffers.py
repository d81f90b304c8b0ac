"""Guidance of a clip as methods see it, and the pixels on which they are judged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal

import numpy as np

from tron.cameras import Camera
from tron.color import to_display
from tron.flow import surface_motion
from tron.neural.reprojection import Motion
from tron.shards.moving import Moving
from tron.shards.schema import TARGET, Clip, light_members

Region = Literal["foreground", "frame"]
REGIONS: tuple[Region, Region] = ("foreground", "frame")
MEMBERS = (*light_members(), TARGET, "mask", "foreground")
"""Members of a clip that predictions and their scores need."""
SURFELS_DEPTH = "depth"
"""Member that motion is known by where a clip is rendered: the surfels', not the truth's."""


@dataclass(frozen=True)
class Buffers:
    """Members of any pixels of a clip, by name.

    Attributes:
        images: (..., C) float32 each, linear.
        exposure: the clip's factor before the tone curve.
        motion: of the surfaces of a whole clip as those know it who render it; None where the depth of the
            surfels was not read.
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
        """One of the members, linear."""
        return self.images[name]

    def displayed(self, name: str) -> np.ndarray:
        """One of the members as displayed: (..., 3) in [0, 1], computed once."""
        if name not in self._displayed:
            self._displayed[name] = to_display(self[name], self.exposure)
        return self._displayed[name]


def _motion(clip: Clip) -> Motion:
    """Motion of a clip's surfaces; what its metadata say of it is read when a match is asked for."""

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

    return lambda index, other: known()(index, other)


def region_mask(clip: Clip, region: Region) -> np.ndarray:
    """Pixels of a region, (K, H, W) bool: the ground-truth foreground, or the whole frame."""
    foreground = clip.frames["foreground"][..., 0] > 0.5
    return foreground if region == "foreground" else np.ones_like(foreground)
