"""The settings of captures that become training pairs: how they are read, reconstructed, cut and split."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator, model_validator

from datagen.settings_model import SettingsModel
from tron.captures.load import CaptureSettings
from tron.reconstruction.settings import FitSettings, ReconstructionSettings


class Shares(SettingsModel):
    """Shares of the captures that go to each split, relative to one another."""

    train: float = Field(default=0.8, ge=0, description="First training split.")
    train_b: float = Field(
        default=0.0, ge=0, description="Second training split, where a recipe of training asks for it."
    )
    validation: float = Field(default=0.1, ge=0, description="Captures whose PSNR training shows.")
    test: float = Field(default=0.1, ge=0, description="Held-out captures, for evaluation alone.")


class CapturedSettings(SettingsModel):
    """Training pairs of real captures: reconstruction, light, clips of consecutive photos, splits."""

    names: list[str] = Field(
        default_factory=list, description="Names of the captures to use; empty: all sub-folders of captures."
    )
    shares: Shares = Field(
        default_factory=lambda: Shares(),
        description="Share of the captures in each split, every capture in one of them, drawn by seed and "
        "name; each split with a share has a capture where there are enough, the largest shares first.",
    )
    split_by_name: bool = Field(
        default=False,
        description="A capture whose name begins with a split's, such as train-000003, is in that split, as "
        "pseudo-captures are; shares say nothing then, and any other name is refused.",
    )
    relit: Path | None = Field(
        default=None,
        description="Folder of path-traced views of the captures under other lights, relit/ of "
        "pseudo-captures: reconstructions are lit by NAME_k_LIGHT/environment.exr as well, in the splits "
        "train_relit, train_b_relit, validation_relit and test_relit.",
    )
    truth: Path | None = Field(
        default=None,
        description="Folder of the captures' truth, truth/ of pseudo-captures: base color of relit clips is "
        "brought to the scale of its maps, a factor a channel, which photos cannot tell; null: it stays as "
        "the photos tell it.",
    )
    relit_frames: int = Field(
        default=1,
        ge=1,
        le=1000,
        description="Views of a relit clip, neighbours in the order of their names; those of "
        "pseudo-captures are eight photos apart.",
    )
    frames: int = Field(
        default=5, ge=1, le=1000, description="Photos of a clip, neighbours in the order of their names."
    )
    width: int = Field(default=256, ge=8, le=8192, description="Frame width in pixels.")
    height: int = Field(
        default=256,
        ge=8,
        le=8192,
        description="Frame height in pixels. Photos are made smaller until they just cover a frame, and cut "
        "at their edges; a capture of smaller photos fails.",
    )
    balance: bool = Field(
        default=True,
        description="Photos are shown as their capture's mean photo would: each divided by its own exposure "
        "and white balance, which the surfels tell. false: as stored; the gains are in the metadata.",
    )
    linear: bool = Field(
        default=False,
        description="Photos become linear light, decoded by the curve that they are thought to have gone "
        "through (sRGB; of path-traced ones AgX): training and evaluation then show them through AgX, like "
        "all other data. false: display values, with the looks of their own curve.",
    )
    guidance_spp: int = Field(
        default=64, ge=2, multiple_of=2, description="Shadow rays per pixel of the surfels' irradiance, even."
    )
    photos: CaptureSettings = Field(
        default_factory=lambda: CaptureSettings(test_every=0),
        description="How captures are read, as by tron-reconstruct; max_side and downscale are those of the "
        "reconstruction alone. test_every holds photos out of both, to judge surfels by, and breaks clips.",
    )
    prior: dict[str, Any] = Field(
        default_factory=lambda: {"_target_": "tron.reconstruction.Joint"},
        description="Source of normals, materials and irradiance, by _target_ (prior=NAME).",
    )
    reconstruction: ReconstructionSettings = Field(
        default_factory=lambda: ReconstructionSettings(),
        description="Surfels, as tron-reconstruct finds them; each capture has a seed of its own.",
    )
    reconstructed: Path | None = Field(
        default=None,
        description="Folder of a dataset of the same captures, made with the same seed, photos, prior, "
        "reconstruction and light: what it found is taken over, and only guidance is made anew.",
    )
    light: FitSettings = Field(
        default_factory=lambda: FitSettings(),
        description="Fit of the light where the prior is not joint, likewise.",
    )

    @model_validator(mode="after")
    def _scales_something(self) -> CapturedSettings:
        if self.truth is not None and self.relit is None:
            raise ValueError("captured.truth scales relit clips: give captured.relit too")
        return self

    @field_validator("shares")
    @classmethod
    def _some_share(cls, value: Shares) -> Shares:
        if not any(value.model_dump().values()):
            raise ValueError("all shares are 0: give one split at least a share of the captures")
        return value

    @field_validator("prior", mode="before")
    @classmethod
    def _has_target(cls, value: Any) -> Any:
        if not isinstance(value, Mapping) or "_target_" not in value:
            raise ValueError("a prior has a _target_: choose one by prior=NAME")
        return value
