"""The settings of pseudo-captures: how photos are taken and stored, and how well poses are known."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from datagen.capture_settings import ViewSettings
from datagen.settings_model import SettingsModel


def _in_order(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError("give [least, greatest]")
    return value


Pixels = Annotated[float, Field(ge=0, le=16)]
Corner = Annotated[float, Field(ge=0, le=0.9)]
Count = Annotated[int, Field(ge=2, le=100_000)]


class LensSettings(SettingsModel):
    """Lens and hands of the photographer: blur on linear light, before the sensor's noise."""

    spread: Annotated[tuple[Pixels, Pixels], AfterValidator(_in_order)] = Field(
        default=(0.3, 0.6),
        description="Least and greatest standard deviation of a capture's Gaussian point spread, pixels.",
        examples=["[0,0.5]"],
    )
    motion: float = Field(
        default=0.4,
        ge=0,
        le=16,
        description="Standard deviation of the way that a hand shakes during a photo, pixels; the way is "
        "straight, its direction any.",
    )
    vignetting: Annotated[tuple[Corner, Corner], AfterValidator(_in_order)] = Field(
        default=(0.0, 0.15),
        description="Least and greatest share of light that a capture's photos lack in their corners; it "
        "grows with the square of the distance from the middle.",
        examples=["[0,0]"],
    )


class PoseNoise(SettingsModel):
    """Errors of the poses that a capture names, as structure from motion leaves them."""

    rotation_deg: float = Field(
        default=0.05, ge=0, le=10, description="Standard deviation of rotation about each axis, degrees."
    )
    translation: float = Field(
        default=0.001,
        ge=0,
        le=0.2,
        description="Standard deviation of a place along each axis, share of the capture's median distance "
        "between camera and surface.",
    )
    points: float = Field(
        default=0.002,
        ge=0,
        le=0.2,
        description="Standard deviation of sparse points along each axis, share of that distance.",
    )


class PseudoCaptureSettings(ViewSettings):
    """Scenes of the splits photographed: folders that hold what photos give, the truth in others beside."""

    views: Annotated[tuple[Count, Count], AfterValidator(_in_order)] = Field(
        default=(40, 60),
        description="Least and greatest number of photos; each capture draws its own.",
        examples=["[8,8]"],
    )
    indoor_spp: int | None = Field(
        default=None,
        ge=1,
        description="Paths per pixel in rooms, where most of them find no window; null: path_spp.",
    )
    file: Literal["jpeg", "png"] = Field(default="jpeg", description="Format of the photos, 8 bits.")
    jpeg_quality: int = Field(default=92, ge=1, le=95, description="Quality of JPEG photos, Pillow's scale.")
    filmic_share: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="Probability that a capture's photos go through a filmic curve (AgX); others are clipped "
        "at white and go through sRGB's.",
    )
    lens: LensSettings = Field(default=LensSettings(), description="Blur and vignetting of the photos.")
    masks: bool = Field(
        default=False,
        description="Also store what is subject in each photo: masks/NAME.png, white where a surface covers "
        "the pixel, exactly and from the true camera. Reconstruct with captured.photos.masks=subject.",
    )
    pose_noise: PoseNoise = Field(default=PoseNoise(), description="Errors of the named poses and points.")
