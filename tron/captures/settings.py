"""Settings of how a capture is read; they wait for none of what reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, Field, field_validator

from tron.captures.masks import MaskMeaning

FEWEST = 3
"""Photos that a video is made at least."""
TRAIN_LIGHT = "sunset"
"""Light of a TensoIR scene's training views."""


class PhotoSettings(BaseModel):
    """Photos of a capture: where they lie, how large they are made, which are held out."""

    images: Path | None = Field(
        default=None,
        description="folder of the photos, from the capture's folder or absolute, where it is not the one "
        "that the poses name",
    )
    max_side: int | None = Field(
        default=None,
        ge=16,
        description="photos are reduced to at most so many pixels a side; null keeps their size",
    )
    downscale: float | None = Field(
        default=None, ge=1, description="or made so many times smaller; wins over max_side"
    )
    test_every: int = Field(
        default=8,
        ge=0,
        description="every n-th photo is held out, the first included, unless the capture says itself which "
        "are; 0 holds out none",
    )
    masks: MaskMeaning | None = Field(
        default="ignore",
        description="black in a photo's mask (mask_path, masks/NAME.png, NAME_mask.png): ignore, it is not "
        "learnt from; subject, it is empty background; null: masks are not read",
    )
    sky: bool = Field(
        default=False,
        description="photos taken outdoors, upright: their open sky is found by colour and smoothness and is "
        "light, not a surface; photos with alpha or a mask of their subject are left as they are",
    )
    depth_unit: float = Field(
        default=0.001,
        gt=0,
        description="world units of one step of depth files: those that transforms.json names or that a "
        "phone recorded, in millimetres by default",
    )
    exr_exposure: float | None = Field(
        default=None,
        gt=0,
        description="factor on linear photos (EXR) before the sRGB curve, as they are learnt from; null: one "
        "for all, such that 98 % of what they show lie below 0.9",
    )
    scale: Literal["gps"] | tuple[str, str, Annotated[float, Field(gt=0)]] | None = Field(
        default=None,
        description="brings the world to metres: by the photos' GPS, or by the metres between the cameras of "
        "two photos; null: the unit of the poses stays",
        examples=["[a.jpg,b.jpg,1.2]"],
    )
    up: tuple[float, float, float] | None = Field(
        default=None, description="up direction in the capture's world; null: estimated from the cameras"
    )

    @field_validator("up")
    @classmethod
    def _has_length(cls, up: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if up is not None and not np.linalg.norm(up) > 1e-6:
            raise ValueError("give a direction that is not zero")
        return up

    def size_of(self, width: int, height: int) -> tuple[int, int]:
        """Width and height that an image of this size is reduced to."""
        factor = self.downscale or 1.0
        if self.downscale is None and self.max_side is not None:
            factor = max(1.0, max(width, height) / self.max_side)
        return max(1, round(width / factor)), max(1, round(height / factor))


class FrameSettings(BaseModel):
    """Frames of a video that become photos."""

    frames: int = Field(
        default=120, ge=FEWEST, description="photos made of a video: the sharpest of as many intervals"
    )


class MatchingSettings(BaseModel):
    """Order of the photos, as the user knows it."""

    matching: Literal["auto", "overlapping", "exhaustive", "sequential"] = Field(
        default="auto",
        description="how photos without poses are matched: overlapping compares each with the sixteen that "
        "share most coarse features with it, exhaustive every pair, sequential each with the ten after it by "
        "name; auto: sequential for videos, else overlapping",
    )


class PosingSettings(MatchingSettings, PhotoSettings):
    """Structure from motion of photos without poses."""

    workspace: Path | None = Field(
        default=None, description="folder that keeps the poses; null: structure_from_motion beside the photos"
    )
    feature_side: int = Field(
        default=1000, ge=64, description="features are sought in copies of at most so many pixels a side"
    )
    features: int = Field(
        default=4096, ge=100, description="largest features that are kept of a photo, places in it"
    )
    threads: int = Field(
        default=0,
        ge=0,
        description="threads; 0: all cores; 1 gives the same poses bit by bit, more nearly so",
    )
    seed: int = Field(default=0, description="root of the random samples that poses are estimated from")


class TensoirSettings(BaseModel):
    """Light of a TensoIR scene: its photos are ``rgba_{light}.png``, or ``rgba.png`` for that of training."""

    tensoir_light: str = Field(
        default=TRAIN_LIGHT, description="which light of a TensoIR scene is reconstructed"
    )
