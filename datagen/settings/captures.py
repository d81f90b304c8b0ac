"""The settings of captures: those that are path-traced, and those that become training pairs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from datagen.settings import LightChoice, SettingsModel
from datagen.settings.split import Rays
from tron.captures.load import CaptureSettings as PhotoSettings
from tron.reconstruction.settings import FitSettings, ReconstructionSettings


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
    read_noise: float = Field(
        default=3.0, ge=0, description="Standard deviation of the sensor's read noise, electrons."
    )


class ViewSettings(SettingsModel):
    """Views of any capture: their light, size and samples, and the other lights that some are seen under."""

    lights: list[LightChoice] = Field(
        default=["overcast", "studio", "sun"],
        min_length=1,
        max_length=64,
        description="Lights of the captures, used in turn; the same choices as a split's lights.",
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
        description="Also store about this number of points on surfaces, with colours, like structure "
        "from motion.",
    )
    sensor: SensorSettings = Field(default=SensorSettings(), description="Camera of the photographs.")
    relights: list[LightChoice] = Field(
        default=[],
        max_length=16,
        description="Other lights, as in a split's lights, under which held-out views are path-traced "
        "into output_dir/relit: the truth for relighting.",
    )
    relight_spp: int = Field(default=144, ge=1, description="Paths per pixel of the relit views.")
    film_frames: int | None = Field(
        default=None,
        ge=1,
        le=10_000,
        description="Render the lights of relights from this number of cameras along the path of the "
        "scene's clips, with true base color and normals, instead of from the held-out views.",
    )


class CaptureSettings(ViewSettings):
    """Scenes of the test split as captures: views from all sides, path-traced under one light, true maps."""

    scenes: int = Field(
        default=4,
        ge=1,
        le=1_000_000,
        description="Number of captures that mode=captures makes, one per test scene.",
    )
    views: int = Field(
        default=64,
        ge=2,
        le=100_000,
        description="Views of a capture from all sides; every 8th is held out, starting with the first.",
    )
    photographs: bool = Field(
        default=False,
        description="Take training views as photographs: a camera balances white for the light on the "
        "scene and meters it as middle grey; each photo has its own exposure, white balance "
        "and noise, by sensor. Held-out views stay clean renders with the camera's colours, "
        "for evaluation.",
    )


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
        description="Standard deviation of the camera shake during a photo, pixels; the shake is "
        "straight, in a random direction.",
    )
    vignetting: Annotated[tuple[Corner, Corner], AfterValidator(_in_order)] = Field(
        default=(0.0, 0.15),
        description="Least and greatest loss of light in the corners of a capture's photos, as a share; "
        "it grows with the square of the distance from the middle.",
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
        description="Standard deviation of positions along each axis, as a share of the capture's median "
        "distance between camera and surface.",
    )
    points: float = Field(
        default=0.002,
        ge=0,
        le=0.2,
        description="Standard deviation of sparse points along each axis, as a share of the same median "
        "distance.",
    )


class PseudoCaptureSettings(ViewSettings):
    """Scenes of the splits photographed: folders that hold what photos give, the truth in others beside."""

    views: Annotated[tuple[Count, Count], AfterValidator(_in_order)] = Field(
        default=(40, 60),
        description="Least and greatest number of photos; each capture draws a number between.",
        examples=["[8,8]"],
    )
    indoor_spp: int | None = Field(
        default=None,
        ge=1,
        description="Paths per pixel in rooms, where most paths find no window; null: path_spp.",
    )
    file: Literal["jpeg", "png"] = Field(
        default="jpeg", description="Format of the photos, 8 bits; JPEG of quality 92."
    )
    filmic_share: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="Probability that a capture's photos have a filmic curve (AgX); others are clipped at "
        "white and have the sRGB curve.",
    )
    lens: LensSettings = Field(default=LensSettings(), description="Blur and vignetting of the photos.")
    masks: bool = Field(
        default=False,
        description="Also store exact masks of the subject: masks/NAME.png, white where a surface covers "
        "the pixel, from the true camera. Reconstruct with captured.photos.masks=subject.",
    )
    pose_noise: PoseNoise = Field(default=PoseNoise(), description="Errors of the stored poses and points.")


class Shares(SettingsModel):
    """Shares of the captures that go to each split, relative to one another."""

    train: float = Field(default=0.8, ge=0, description="First training split.")
    train_b: float = Field(
        default=0.0, ge=0, description="Second training split, for training recipes that use one."
    )
    validation: float = Field(default=0.1, ge=0, description="Captures for the PSNR shown during training.")
    test: float = Field(default=0.1, ge=0, description="Held-out captures, for evaluation alone.")


class CapturedSettings(SettingsModel):
    """Training pairs of real captures: reconstruction, light, clips of consecutive photos, splits."""

    names: list[str] = Field(
        default_factory=list, description="Names of the captures to use; empty: all sub-folders of captures."
    )
    shares: Shares = Field(
        default_factory=lambda: Shares(),
        description="Share of the captures in each split. Each capture is in one split, drawn by seed and "
        "name. If there are enough captures, each split with a share has one, the largest "
        "shares first.",
    )
    split_by_name: bool = Field(
        default=False,
        description="Put a capture into the split that its name begins with, such as train-000003; "
        "pseudo-captures have such names. Shares are then ignored, and any other name is "
        "refused.",
    )
    relit: Path | None = Field(
        default=None,
        description="Folder of path-traced views of the captures under other lights (relit/ of "
        "pseudo-captures): reconstructions are also lit by NAME_k_LIGHT/environment.exr, in "
        "the splits train_relit, train_b_relit, validation_relit and test_relit.",
    )
    truth: Path | None = Field(
        default=None,
        description="Folder of the captures' truth (truth/ of pseudo-captures): base color of relit clips "
        "is scaled to its maps by one factor per channel, which photos do not determine; "
        "null: not scaled.",
    )
    frames: int = Field(
        default=5, ge=1, le=1000, description="Photos of a clip, consecutive in the order of their names."
    )
    width: int = Field(default=256, ge=8, le=8192, description="Frame width in pixels.")
    height: int = Field(
        default=256,
        ge=8,
        le=8192,
        description="Frame height in pixels. Photos are reduced until they just cover a frame, then "
        "cropped; a capture of smaller photos fails.",
    )
    balance: bool = Field(
        default=True,
        description="Divide each photo by its exposure and white balance relative to the capture's mean "
        "photo, estimated on the surfels. false: photos are stored as they are; the gains are "
        "in the metadata.",
    )
    linear: bool = Field(
        default=False,
        description="Decode photos to linear light by their assumed curve (sRGB; AgX for path-traced "
        "views): training and evaluation then show them through AgX, like all other data. "
        "false: display values, with the look of their own curve.",
    )
    guidance_spp: Rays = Field(
        default=64,
        description="Shadow rays per pixel of the surfels' irradiance, even; preview or final as in splits.",
    )
    photos: PhotoSettings = Field(
        default_factory=lambda: PhotoSettings(test_every=0),
        description="How captures are read, as in tron-reconstruct; max_side and downscale concern the "
        "reconstruction alone. test_every holds photos out of reconstruction and clips, to "
        "evaluate surfels, and divides clips.",
    )
    prior: dict[str, Any] = Field(
        default_factory=lambda: {"_target_": "tron.reconstruction.Joint"},
        description="Source of normals, materials and irradiance, by _target_ (prior=NAME).",
    )
    reconstruction: ReconstructionSettings = Field(
        default_factory=lambda: ReconstructionSettings(),
        description="Reconstruction of surfels, as in tron-reconstruct; each capture has a separate seed.",
    )
    reconstructed: Path | None = Field(
        default=None,
        description="Folder of a dataset of the same captures, made with the same seed, photos, prior, "
        "reconstruction and light: its reconstructions are reused, and only guidance is made "
        "again.",
    )
    light: FitSettings = Field(
        default_factory=lambda: FitSettings(),
        description="Fit of the light, if the prior is not joint, as in tron-reconstruct.",
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
