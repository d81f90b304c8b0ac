"""The settings of captures that are path-traced: their views, their light, and the camera of photographs."""

from __future__ import annotations

from pydantic import Field

from datagen.lights import LightChoice
from datagen.settings_model import SettingsModel


class SensorSettings(SettingsModel):
    """Camera that photographs are taken with: its exposure and white balance, and its noise."""

    exposure_stops: float = Field(
        default=0.25,
        ge=0,
        le=4,
        description="Standard deviation of photos' exposures, stops; mean 0.",
    )
    white_balance: float = Field(
        default=0.05,
        ge=0,
        le=1,
        description="Standard deviation of log gains on red and blue.",
    )
    electrons: float = Field(
        default=5000.0,
        gt=0,
        description="Electrons that the sensor counts where light times exposure is 1; middle grey is 0.18.",
    )
    read_noise: float = Field(default=3.0, ge=0, description="Standard deviation of reading them, electrons.")


class ViewSettings(SettingsModel):
    """Views of any capture: their light, size and samples, and the other lights that some are seen under."""

    lights: list[LightChoice] = Field(
        default=["overcast", "studio", "sun"],
        min_length=1,
        max_length=64,
        description="Light of each capture, in rotation, as in a split's lights.",
    )
    width: int = Field(default=128, ge=8, le=8192, description="View width in pixels.")
    height: int = Field(default=128, ge=8, le=8192, description="View height in pixels.")
    path_spp: int = Field(
        default=64,
        ge=1,
        description="Paths per pixel; rounded up to a product of near numbers, such as 8 x 8.",
    )
    reference_spp: int = Field(default=32, ge=2, description="Shadow rays per pixel of the irradiance maps.")
    points: int | None = Field(
        default=None,
        ge=1,
        le=10_000_000,
        description="Also store about so many points on surfaces, with their colours, as photos would give.",
    )
    sensor: SensorSettings = Field(default=SensorSettings(), description="Camera of the photographs.")
    relights: list[LightChoice] = Field(
        default=[],
        max_length=16,
        description="Other lights, as in a split's lights, under which the held-out views are path-traced as "
        "well, into output_dir/relit: the truth of relighting.",
    )
    relight_spp: int = Field(default=144, ge=1, description="Paths per pixel of those.")


class CaptureSettings(ViewSettings):
    """Scenes of the test split as captures: views from all sides, path-traced under one light, true maps."""

    scenes: int = Field(
        default=4,
        ge=1,
        le=1_000_000,
        description="Captures that mode=captures makes, of as many test scenes.",
    )
    views: int = Field(
        default=64,
        ge=2,
        le=100_000,
        description="Views of a capture from all sides; each 8th is held out, from the first.",
    )
    photographs: bool = Field(
        default=False,
        description="Take training views as photographs, each with its own exposure, white balance and noise "
        "by sensor; held-out views stay true renders, which reconstructions are judged by.",
    )
