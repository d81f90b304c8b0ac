"""The settings of one split of a dataset, and of the source of its scenes' surfels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PositiveInt, ValidationInfo, field_validator, model_validator

from datagen.settings import LightChoice, ProceduralName, SettingsModel, StyleChoice, ThingName
from tron.seeds import generator

Rays = Annotated[int, Field(ge=2, multiple_of=2)] | Literal["preview", "final"]


class SplitSettings(SettingsModel):
    """One split: number and kind of its scenes, and their rendering."""

    scenes: int = Field(ge=0, le=1_000_000, description="Number of scenes.")
    style: (
        StyleChoice
        | Annotated[list[StyleChoice], Field(min_length=1)]
        | Annotated[dict[str, PositiveInt], Field(min_length=1)]
    ) = Field(
        default="table",
        description="Objects of a scene, what they stand on, and the camera path. Styles in a list "
        "alternate; {object: 15, table: 25} gives the first 15 scenes one style and the next "
        "25 another.",
        examples=["[mixed,table]"],
    )
    things: list[ThingName] = Field(
        default=[],
        description="Kinds of procedural objects, equally likely, instead of the style's kinds; []: as in "
        "the style.",
        examples=["[vase,mug,book]"],
    )
    materials: list[ProceduralName] = Field(
        default=[],
        description="Families of procedural materials, for objects and for what they stand on: those that "
        "suit a piece, or any of these if none does; []: all.",
        examples=["[paint,plastic,metal]"],
    )
    lights: list[LightChoice] = Field(
        default=["any"] * 4,
        max_length=64,
        description="Light of each clip of a scene, one clip per entry. any draws from families; high, "
        "medium and low draw a light of this contrast; hdri takes a map of environments. [], "
        "in test alone: three maps of environments if given, else a sun, a studio and an "
        "overcast sky.",
    )
    lights_share_path: bool = Field(
        default=True,
        description="All clips of a scene have the same cameras: each frame is path-traced under all "
        "lights at once, with shared paths, rays and G-buffers. false: each clip begins at "
        "another place.",
    )
    moving_objects: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Share of scenes in whose clips an object is lifted and turned; such frames cost more.",
    )
    moving_lights: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Share of lights that turn about the zenith during their clip; such frames cost more.",
    )
    still_camera: bool = Field(
        default=False,
        description="All frames of a clip have the camera of its first frame, so only moving objects and "
        "lights change.",
    )
    frames: int = Field(default=5, ge=1, le=1000, description="Number of consecutive frames of a clip.")
    width: int = Field(default=256, ge=8, le=8192, description="Frame width in pixels.")
    height: int = Field(default=256, ge=8, le=8192, description="Frame height in pixels.")
    path_spp: int = Field(
        default=256,
        ge=1,
        description="Paths per pixel of path-traced frames; rounded up to a product of near numbers.",
    )
    window_of: list[Annotated[int, Field(ge=8, le=8192)]] = Field(
        default=[],
        description="Widths, in pixels, of larger pictures of which frames are windows, width x height "
        "pixels around a visible object: many scales at the cost of small frames. []: frames "
        "are whole pictures.",
        examples=["[128,256,512,1024]"],
    )
    window_each: Literal["clip", "frame"] = Field(
        default="clip",
        description="What shares one size and place of window_of: a clip of neighbouring frames, or each "
        "frame separately.",
    )
    guidance_spp: Rays | Annotated[list[Rays], Field(min_length=1)] = Field(
        default=64,
        description="Shadow rays per pixel of the surfels' irradiance, even; preview and final are the "
        "rays, filter, sub-pixels and reflections of these qualities of tron-relight. Clips "
        "of a scene use the entries of a list in turn.",
        examples=["[preview,8,32,final]"],
    )
    reference_buffers: bool = Field(
        default=False,
        description="Also store Mitsuba's direct irradiance, with and without shadows, and base color, "
        "normals, depth, roughness and metallic, true and of the surfels.",
    )
    reference_spp: int = Field(
        default=128, ge=2, description="Shadow rays per pixel of Mitsuba's direct irradiance."
    )

    @field_validator("window_of")
    @classmethod
    def _holds_the_frame(cls, value: list[int], info: ValidationInfo) -> list[int]:
        width = info.data.get("width")
        if width is not None and any(side < width for side in value):
            raise ValueError(f"a picture of {min(value)} pixels has no window of width={width}")
        return value

    @property
    def pictures(self) -> list[tuple[int, int]]:
        """Width and height, pixels, of the pictures that frames are windows of; of the frames without."""
        return [(width, round(width * self.height / self.width)) for width in self.window_of or [self.width]]

    def rays_of(self, light: int, order: Callable[[int], np.ndarray]) -> Rays:
        """Return ``guidance_spp`` for the clip under light number ``light``.

        Args:
            order: a number of things -> an order of theirs that the scene drew, so that neither its style
                nor the place of a light in the list goes with a quality.
        """
        if not isinstance(self.guidance_spp, list):
            return self.guidance_spp
        count = len(self.guidance_spp)
        return self.guidance_spp[order(count)[light % count]]

    @field_validator("style", mode="before")
    @classmethod
    def _is_not_one_of_old(cls, value: Any) -> Any:
        for name in value if isinstance(value, (list, dict)) else [value]:
            if name in ("A", "B"):
                raise ValueError(f"style {name} is no more; write {'table' if name == 'A' else 'object'}")
        return value

    @field_validator("style")
    @classmethod
    def _counts_every_scene(cls, value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, dict):
            return value
        from datagen.world.styles import STYLES

        if unknown := [name for name in value if name not in ("mixed", *STYLES)]:
            raise ValueError(f"no style '{unknown[0]}'; there are mixed, {', '.join(STYLES)}")
        scenes = info.data.get("scenes")
        if scenes is not None and sum(value.values()) != scenes:
            counts = " + ".join(map(str, value.values()))
            raise ValueError(f"it counts {counts} scenes, but scenes={scenes}: make them equal")
        return value

    def style_of(self, index: int) -> StyleChoice:
        """Return the style of scene number ``index``; styles and counts repeat after the last."""
        if isinstance(self.style, dict):
            ends = np.cumsum(list(self.style.values()))
            return list(self.style)[int(np.searchsorted(ends, index % ends[-1], side="right"))]
        return self.style[index % len(self.style)] if isinstance(self.style, list) else self.style


Source = Literal["gbuffers", "reconstruction"]
PriorName = Literal["ground_truth", "joint"]


class SurfelSources(SettingsModel):
    """Shares of the scenes by source of their surfels; a single name gives that source all scenes."""

    gbuffers: float = Field(
        default=1.0,
        ge=0,
        description="Share of scenes whose surfels are made from true G-buffers: clean guidance, soon made.",
    )
    reconstruction: float = Field(
        default=0.0,
        ge=0,
        description="Share of scenes whose surfels are reconstructed from path-traced pictures, as captures "
        "are: their flaws are in the guidance, for the network to mend.",
    )

    @model_validator(mode="before")
    @classmethod
    def _one_alone(cls, value: Any) -> Any:
        if value in ("gbuffers", "reconstruction"):
            return {"gbuffers": 0.0, "reconstruction": 0.0, value: 1.0}
        return value

    @model_validator(mode="after")
    def _some(self) -> SurfelSources:
        if not self.gbuffers + self.reconstruction > 0:
            raise ValueError("one share must be above 0")
        return self

    def of(self, seed: int, split: str, index: int) -> Source:
        """Return the source of a scene's surfels, which depends only on root seed, split and index."""
        total = self.gbuffers + self.reconstruction
        drawn = generator(seed, split, index, "surfels_from").random() * total
        return "reconstruction" if drawn < self.reconstruction else "gbuffers"


class SurfelReconstruction(SettingsModel):
    """Settings: reconstruct a scene's surfels from its own views, path-traced under one of its lights."""

    prior: PriorName = Field(
        default="ground_truth",
        description="ground_truth: the scene's true normals and materials guide it, as a very good prior "
        "would; joint: nothing but the pictures.",
    )
    steps_scaler: float = Field(
        default=0.1,
        gt=0,
        le=100,
        description="Factor on the steps of its stages: 0.1 takes 3,000 + 700, 1 the paper's 30,000 + 7,000.",
    )
    proxy: Literal["auto", "always", "never"] = Field(
        default="auto",
        description="Whether light sees a proxy of such surfels, as in tron-relight: where they are thick, "
        "always, or never. Scenes in which things move have none.",
    )
    path_spp: int = Field(default=64, ge=1, description="Paths per pixel of the views.")
    reference_spp: int = Field(
        default=16, ge=2, description="Shadow rays per pixel of their true irradiance, which is kept beside."
    )
    checkpoint_every: int = Field(
        default=500, ge=1, description="Steps between checkpoints, which an interrupted run goes on from."
    )
