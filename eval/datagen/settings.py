"""Settings of the benchmark `datagen`."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, PositiveFloat, PositiveInt

from eval.benchmark import Benchmark

Part = Literal[
    "variety",
    "sharing",
    "workers",
    "soak",
    "kills",
    "specifications",
    "throughput",
    "captured",
    "hostile",
    "reader",
    "merge",
    "paper_smoke",
]


class VarietySettings(BaseModel):
    """The two worlds, the training, and what both are judged by."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    old: list[str] = Field(description="arguments of tron-datagen: the old distribution, with test scenes")
    new: list[str] = Field(description="the same: the new one, as many lights and frames")
    train: dict[str, list[str]] = Field(
        description="name of a renderer -> arguments of tron-train; figures without a name are the first's",
        min_length=1,
    )
    max_seconds: PositiveFloat = Field(default=250, description="wall time of each training")
    seeds: list[int] = Field(default=[0], description="seeds of the training, one of each world for each")
    real_data: Path | None = Field(description="folder with assets and hdri; null: no judging by real models")
    judge: list[str] = Field(
        default=["experiment=models"], description="arguments of tron-datagen for scenes of real models"
    )
    alone: list[str] = Field(description="further ones of those of one model")
    mixed: dict[str, list[str]] = Field(
        description="name -> further ones of those of models among procedural things"
    )
    pictures: NonNegativeInt = Field(default=3, description="scenes of each judge that are shown")


class CapturedSettings(BaseModel):
    """Captures, and their training pairs; recipes are arguments of tron-datagen."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    views: list[str] = Field(description="captures of the run that is timed, of development seeds")
    timed: list[str] = Field(description="their pairs")
    small_views: list[str] = Field(description="captures of the runs that are killed")
    small: list[str] = Field(description="their pairs")
    most_steps_seconds: PositiveFloat = Field(
        default=5.0, description="seconds into the steps of stage 1 within which one is killed"
    )


class ReaderSettings(BaseModel):
    """Clips that are written to be read."""

    clips: PositiveInt = Field(default=3, description="clips, each a shard")
    frames: int = Field(default=93, ge=5, description="frames of a clip")
    width: PositiveInt = Field(default=256, description="width and height of a frame, pixels")
    samples: PositiveInt = Field(default=20, description="samples by index of a round")
    rounds: PositiveInt = Field(default=5, description="rounds, in which all ways take turns")


class DatagenSettings(Benchmark):
    """Sizes and recipes of the parts; recipes are arguments of tron-datagen."""

    name: ClassVar[str] = "datagen"

    parts: list[Part] = Field(description="what is measured", min_length=1)
    seed: int = Field(default=1000, description="seed of the judging scenes, the kills and the intervals")
    variety: VarietySettings
    sharing: list[str] = Field(description="scenes whose frames are path-traced under many lights")
    workers: list[str] = Field(description="scenes that one worker and two make")
    rounds: PositiveInt = Field(default=2, description="rounds of that")
    tiny: list[str] = Field(description="recipe of tiny scenes, of the train split alone")
    soak_scenes: PositiveInt = Field(default=500, description="tiny scenes over which memory is watched")
    kills: PositiveInt = Field(default=20, description="times that runs are killed")
    kill_scenes: PositiveInt = Field(default=8, description="tiny scenes of such a run")
    merge_scenes: PositiveInt = Field(default=7, description="tiny scenes that are made in three parts")
    specified_scenes: PositiveInt = Field(default=16, description="tiny scenes whose specifications are held")
    specified: list[str] = Field(
        default=["train.lights=[any,high,low]"], description="further arguments of tron-datagen for those"
    )
    throughput: list[str] = Field(description="recipe of the frames that are counted")
    reader: ReaderSettings = Field(default=ReaderSettings(), description="clips that are read")
    sizes: dict[PositiveInt, list[str]] = Field(description="width of a frame -> further arguments")
    captured: CapturedSettings
