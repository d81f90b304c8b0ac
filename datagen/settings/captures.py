"""The settings of captures: those that are path-traced, and those that become training pairs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from datagen.settings import SettingsModel
from datagen.settings.split import Rays
from datagen.world.lights import LightChoice
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
    film_frames: int | None = Field(
        default=None,
        ge=1,
        le=10_000,
        description="Show the lights of relights from so many places along the path of the scene's clips, "
        "with true base color and normals, instead of from the held-out views.",
    )


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
        "by sensor, by a camera that balances white for the light on what it sees and meters it as middle "
        "grey; held-out views stay true renders in its colours, which reconstructions are judged by.",
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
    file: Literal["jpeg", "png"] = Field(
        default="jpeg", description="Format of the photos, 8 bits; JPEG of quality 92."
    )
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
    guidance_spp: Rays = Field(
        default=64,
        description="Shadow rays per pixel of the surfels' irradiance, even; preview or final as of splits.",
    )
    photos: PhotoSettings = Field(
        default_factory=lambda: PhotoSettings(test_every=0),
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
