"""`prior=joint`: settings of what finds light and materials from photos alone (:mod:`.explanation`)."""

from __future__ import annotations

from pydantic import Field

from tron.priors.linear_light import ToneCurve
from tron.reconstruction.inverse_rendering import RefinementSettings
from tron.reconstruction.joint_light import LightSettings
from tron.reconstruction.settings import Settings


class Joint(Settings):
    """Prior of nothing but photos: light and materials are what explains them on the surfels."""

    tone_curve: ToneCurve = Field(
        default="srgb", description="Display curve of the images: srgb for photos, agx for path-traced ones."
    )
    same_exposure: bool = Field(
        default=False, description="All photos are exposed and white-balanced alike; false: each by itself."
    )
    roughness: float = Field(default=0.6, ge=0, le=1, description="Roughness where no lobe is seen.")
    sun: float = Field(
        default=0.005, ge=0, le=1,
        description="Share of the differences between neighbours that a sun must explain to be one; 1: none.",
    )  # fmt: skip
    rounds: int = Field(default=1, ge=1, description="Times that light and materials are found in turns.")
    light: LightSettings = Field(default_factory=lambda: LightSettings(), description="Fit of the light.")
    refinement: RefinementSettings = Field(
        default_factory=lambda: RefinementSettings(), description="Materials against the photos, last of all."
    )
