"""Settings of the benchmark `renderer`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, PositiveFloat, PositiveInt

from eval.benchmark import Benchmark
from tron.neural.windows import Overlap

Part = Literal[
    "synthetic",
    "models",
    "captures",
    "stages",
    "clips",
    "shadows",
    "seeds",
    "throughput",
    "kills",
    "cosmos",
]
Kind = Literal["pair", "lit"]
"""Checkpoint: of the paper's two buffers, or with lit."""
Recipe = list[str]
"""Arguments of tron-datagen or tron-train, but for what it reads and where it writes."""
Sizes = Annotated[dict[PositiveInt, Recipe], Field(min_length=1)]


class CaptureRecipes(BaseModel):
    """Captures whose truth is hidden, and their reconstructions under other lights."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    views: Recipe = Field(description="arguments of tron-datagen: photographs, and the truth relit beside")
    pairs: Recipe = Field(description="those that reconstruct the photographs and relight what comes of it")


class TrainingRecipes(BaseModel):
    """Everything that the checkpoints' own training needs."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    data: Recipe = Field(description="arguments of tron-datagen: synthetic scenes")
    clips: Recipe = Field(description="arguments of tron-datagen: synthetic clips of neighbouring frames")
    captures: CaptureRecipes = Field(description="captures that later stages learn from")
    splits: dict[str, str] = Field(
        description="split, as the recipe of training names it -> captures#SPLIT or clips#SPLIT"
    )
    recipe: Recipe = Field(description="arguments of tron-train, for both")
    own: dict[Kind, Recipe] = Field(description="further ones of each checkpoint")


class KillSettings(BaseModel):
    """A training so short that it can be killed again and again."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    data: Recipe = Field(description="arguments of tron-datagen: a tiny data set")
    training: Recipe = Field(description="arguments of tron-train: a tiny training with checkpoints")
    count: PositiveInt = Field(default=10, description="signals in all, SIGTERM and SIGKILL in turns")


class ThroughputSettings(BaseModel):
    """Frames that are counted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sizes: list[PositiveInt] = Field(default=[64, 128, 256, 512], description="width of square frames")
    rounds: PositiveInt = Field(default=5, description="rounds, in which all take turns; medians count")


class SeedSettings(BaseModel):
    """Repetitions under other seeds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    inference: PositiveInt = Field(default=4, description="seeds under which the same buffers are rendered")
    clips: PositiveInt = Field(default=3, description="clips that are rendered")
    training: list[int] = Field(
        default=[0, 1, 2, 3], description="seeds of short trainings whose spread is measured; []: none"
    )
    data: Recipe = Field(
        default=[],
        description="arguments of tron-datagen for what they learn; unused where benchmark.data "
        "names a data set `training` or train=true makes it",
    )
    recipe: Recipe = Field(default=[], description="arguments of tron-train for those")
    side_by_side: PositiveInt = Field(default=2, description="trainings at a time, of a thread each")


class RendererSettings(Benchmark):
    """Checkpoints, recipes and sizes of the parts; recipes are arguments of the other commands."""

    name: ClassVar[str] = "renderer"

    parts: list[Part] = Field(description="what is measured", min_length=1)
    what: dict[Part, str] = Field(description="part -> what it asks, in a line")
    seed: int = Field(default=0, description="seed of the kills, the fits and the intervals")
    threads: PositiveInt = Field(default=1, description="threads that the networks use")

    pair: str | None = Field(
        default="pair", description="checkpoint of the paper's pair: a file or a shipped name; null: none"
    )
    lit: str | None = Field(
        default="lit", description="checkpoint that starts from lit, likewise; null: none"
    )
    train: bool = Field(
        default=False, description="train both checkpoints here first, on data made here: hours"
    )
    training: dict[Kind, Path] = Field(
        default={}, description="folder that tron-train wrote with checkpoints/N-NAME.safetensors"
    )
    training_recipes: TrainingRecipes = Field(description="what train=true runs")

    data: dict[str, Path] = Field(
        default={},
        description="data sets that are there already, by the names that this benchmark gives its own: "
        "synthetic_128, models_128, captures, shadows, training, training_clips, training_captures, "
        "seed_training, kills",
    )
    synthetic: Sizes = Field(description="width of a frame -> recipe of held-out scenes and lights")
    real_data: Path | None = Field(description="folder with assets and hdri; null: no models")
    models: Sizes = Field(description="width of a frame -> recipe of scenes of those models")
    captures: CaptureRecipes = Field(description="held-out captures")
    shadows: Recipe = Field(description="clips in which an occluder moves")
    pixel_mlp: Recipe | None = Field(
        default=None,
        description="arguments of tron-train for the per-pixel baselines, trained on the training split of "
        "each test distribution that has one; null: without them",
    )

    window: PositiveInt = Field(default=1, description="frames a pass in everything but clips")
    clip_window: PositiveInt = Field(default=5, description="frames a pass in clips")
    overlap: Overlap = Field(default="anchor", description="how windows overlap where one figure is wanted")
    overlaps: list[Overlap] = Field(
        default=["newest", "mean", "anchor"], description="ways that clips compares"
    )
    seeds: SeedSettings = SeedSettings()
    throughput: ThroughputSettings = ThroughputSettings()
    kills: KillSettings
    cosmos_sizes: list[PositiveInt] = Field(
        default=[64, 128, 192],
        min_length=3,
        description="width of the small frames that time is projected from, multiples of 16",
    )
    pictures: NonNegativeInt = Field(default=3, description="scenes of each distribution that are shown")
    folds: PositiveInt = Field(
        default=4,
        ge=2,
        description="where a distribution has no training split: groups of scenes, each judged by fits on "
        "the others",
    )
    max_seconds: PositiveFloat | None = Field(
        default=None, description="wall time of each checkpoint's training; null: the recipe's"
    )
