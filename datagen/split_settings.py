"""The settings of one split of a dataset."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import Field, PositiveInt, ValidationInfo, field_validator

from datagen.lights import LightChoice
from datagen.settings_model import SettingsModel
from datagen.styles import STYLES, StyleChoice


class SplitSettings(SettingsModel):
    """One split: how many scenes of which kind, and how they are rendered."""

    scenes: int = Field(ge=0, le=1_000_000, description="Number of scenes.")
    style: (
        StyleChoice
        | Annotated[list[StyleChoice], Field(min_length=1)]
        | Annotated[dict[str, PositiveInt], Field(min_length=1)]
    ) = Field(
        default="A",
        description="What stands in a scene, on what, and how it is filmed. Scenes take those of a list in "
        "turns; {object: 15, table: 25} makes the first 15 scenes of one and the next 25 of another.",
        examples=["[mixed,A]"],
    )
    lights: list[LightChoice] = Field(
        default=["any"] * 4,
        min_length=1,
        max_length=64,
        description="Light of each clip of a scene, one clip for each in the list. any draws one of "
        "families; high, medium and low draw one of such contrast; hdri takes one of the maps in "
        "environments.",
    )
    lights_share_path: bool | None = Field(
        default=None,
        description="All clips of a scene show it from the same cameras: each frame is path-traced under all "
        "lights at once, which share its paths, rays and G-buffers. null: in every style but A and B, "
        "whose clips begin at places of their own.",
    )
    moving_objects: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Share of scenes in whose clips an object is lifted and turned; their frames cost more.",
    )
    moving_lights: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Share of lights that turn about the zenith within their clip; their frames cost more.",
    )
    still_camera: bool = Field(
        default=False,
        description="All frames of a clip are seen from the place of its first: what changes is what moves.",
    )
    frames: int = Field(default=5, ge=1, le=1000, description="Consecutive frames of a clip.")
    width: int = Field(default=256, ge=8, le=8192, description="Frame width in pixels.")
    height: int = Field(default=256, ge=8, le=8192, description="Frame height in pixels.")
    path_spp: int = Field(
        default=256,
        ge=1,
        description="Paths per pixel of path-traced frames; rounded up to a product of near numbers.",
    )
    guidance_spp: int = Field(
        default=64, ge=2, multiple_of=2, description="Shadow rays per pixel of the surfels' irradiance, even."
    )
    reference_buffers: bool = Field(
        default=False,
        description="Also store Mitsuba's direct irradiance, with and without shadows, base color, normals, "
        "depth, roughness and metallic, and the surfels' own.",
    )
    reference_spp: int = Field(
        default=128, ge=2, description="Shadow rays per pixel of Mitsuba's direct irradiance."
    )

    @field_validator("style")
    @classmethod
    def _counts_every_scene(cls, value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, dict):
            return value
        if unknown := [name for name in value if name not in ("mixed", *STYLES)]:
            raise ValueError(f"no style '{unknown[0]}'; there are mixed, {', '.join(STYLES)}")
        scenes = info.data.get("scenes")
        if scenes is not None and sum(value.values()) != scenes:
            counts = " + ".join(map(str, value.values()))
            raise ValueError(f"it counts {counts} scenes, but scenes={scenes}: make them equal")
        return value

    def style_of(self, index: int) -> StyleChoice:
        """Style of the scene of that number; counts begin anew behind the last of them, as lists do."""
        if isinstance(self.style, dict):
            ends = np.cumsum(list(self.style.values()))
            return list(self.style)[int(np.searchsorted(ends, index % ends[-1], side="right"))]
        return self.style[index % len(self.style)] if isinstance(self.style, list) else self.style
