"""Settings of tron-train, checked before anything heavy is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from train.curriculum import Stage
from tron.neural.shipped import SHIPPED
from tron.shards.dataset_folder import DatasetPlace

LoggerName = Literal["csv", "tensorboard", "wandb"]
Precision = Literal["32-true", "bf16-mixed", "bf16-true", "16-mixed", "16-true", "64-true"]

HELD_OUT = "test"
"""The split used by evaluation; splits whose names begin with it, such as test_relit, are too."""


class OptimizerSettings(BaseModel):
    """The optimiser and its schedule, the same in every stage."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    learning_rate: float = Field(default=1e-3, gt=0, description="Peak learning rate of AdamW.")
    muon_learning_rate: float | None = Field(
        default=None,
        gt=0,
        description="Peak rate of Muon (0.02 is usual) for the matrices between hidden layers, AdamW for the "
        "rest; null: AdamW alone.",
    )
    betas: tuple[float, float] = Field(default=(0.9, 0.99), description="AdamW's averaging rates.")
    weight_decay: float = Field(default=1e-2, ge=0, description="AdamW's decoupled weight decay.")
    warmup_steps: int = Field(default=50, ge=0, description="Steps of linear warm-up in each stage.")
    gradient_clip: float | None = Field(
        default=1.0, gt=0, description="Largest norm of the gradient; null: no clipping."
    )
    ema_decay: float | None = Field(
        default=None,
        gt=0,
        lt=1,
        description="Decay of an exponential moving average of the weights; null: none.",
    )


class LossSettings(BaseModel):
    """Weights of the loss's terms."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    l2: float = Field(
        default=1.0, ge=0, description="Weight of the squared error of display values in [-1, 1]."
    )
    psnr: float = Field(
        default=0.0,
        ge=0,
        description="Weight of the negative PSNR in dB, per frame: errors of a good frame count in "
        "proportion as much as those of a bad frame (the loss of NAFNet).",
    )
    psnr_ceiling: float = Field(
        default=50.0,
        gt=0,
        description="dB that the PSNR of the loss approaches but never reaches, so that better frames "
        "gain nothing. Lower it with data.mend; otherwise frames that are already right "
        "dominate the loss.",
    )
    lpips: float = Field(default=1.0, ge=0, description="Weight of LPIPS (VGG); needs vgg_weights.")
    vgg_weights: Path | None = Field(
        default=None, description="Local vgg16-397923af.pth; without it LPIPS is absent and the log says so."
    )


class DataSettings(BaseModel):
    """Reading and augmenting samples."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    cache_gb: float = Field(
        default=4.0,
        ge=0,
        description="Keep decoded splits up to this size in memory, in each process; for larger splits "
        "each sample reads its frames.",
    )
    workers: int = Field(
        default=0, ge=0, description="Loader processes of splits that are not in memory; others use none."
    )
    flip: float = Field(default=0.5, ge=0, le=1, description="Probability of mirroring left and right.")
    permute_colors: float = Field(
        default=0.0, ge=0, le=1, description="Probability of shuffling R, G and B, the same in all buffers."
    )
    tint: float = Field(
        default=0.0,
        ge=0,
        description="Standard deviation of the logarithm of random gains on the light's R, G and B.",
    )
    exposure: float = Field(
        default=0.0,
        ge=0,
        description="Standard deviation, in stops, of a random exposure, the same for all linear buffers.",
    )
    rotate: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Probability of rotating a sample: by one, two or three quarter turns if it is "
        "square, else by a half turn.",
    )
    mix_lights: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Share of the samples that show their scene under a mix of two of its lights.",
    )
    mend: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Share of the samples in which lit is replaced by the truth (half of them) or by a "
        "mix of both, so that a network learns to leave correct input unchanged.",
    )
    damaged_limit: float = Field(
        default=0.01,
        ge=0,
        le=1,
        description="Largest share of damaged samples in a stage, counted over at least 1000; above it "
        "the run ends.",
    )


class ValidationSettings(BaseModel):
    """Clips whose PSNR is shown during training; it selects no checkpoint and stops nothing early."""

    DEFAULT: ClassVar[str] = "validation"

    model_config = ConfigDict(extra="forbid", frozen=True)

    split: str | None = Field(
        default=DEFAULT,
        description="Split to validate on; null, or a missing split `validation`: no validation.",
    )
    clips: int = Field(default=8, ge=1, description="Number of clips of the split, spread evenly over it.")
    every: int = Field(default=250, ge=1, description="Steps between validations.")
    pictures: int = Field(
        default=3,
        ge=0,
        description="Held-out frames shown after each validation, in output_dir/validation and the loggers.",
    )
    batch_pixels: int = Field(
        default=2**22,
        ge=1,
        description="Pixels that go through the network at a time, over all frames; a window of a stage's "
        "K frames is never split.",
    )


# Half of the samples come from stage 1's split, so that it is not forgotten.
_REHEARSED: dict[str, Any] = {"rehearsal_split": "train", "rehearsal_ratio": 0.5, "learning_rate": 0.5}
THREE_STAGES = [
    Stage(name="synthetic", split="train", steps=3000, crop=64),
    Stage(name="adapt", split="train_b", steps=1000, crop=64, **_REHEARSED),
    Stage(name="video", split="train_b", frames=5, steps=1000, batch_size=4, crop=64, **_REHEARSED),
]
"""The paper's curriculum, with a second path-traced split of another distribution for real photographs.

It shows that the curriculum works, but not the gain from real data.
"""


class MemorySettings(BaseModel):
    """Memory of the backward pass."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    checkpoint_activations: bool = Field(
        default=False,
        description="Keep only the input of each transformer block and recompute the block in the "
        "backward pass: a third more time for much less memory.",
    )


class Settings(BaseModel):
    """Settings of tron-train."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    dataset: DatasetPlace = Field(
        description="Dataset folder that tron-datagen wrote, or its URL; or shards by name, read "
        "sequentially: 'pipe:ssh host cat data/train-{00000..00003}.tar'."
    )
    splits: dict[str, str] = Field(
        default={},
        description="Splits that come from another dataset, by the names that stages and validation use: "
        "FOLDER, or FOLDER#SPLIT if the split has another name there; FOLDER#A+B joins two.",
    )
    output_dir: Path = Field(
        description="Folder for renderer.safetensors, checkpoints, metrics.csv, config.yaml."
    )
    renderer: dict[str, Any] = Field(
        description="The network to train, a `_target_` (group: tiny, unet, pixel_mlp, cosmos)."
    )
    start_from: Path | None = Field(
        default=None,
        description="The renderer.safetensors of another run, of the same shape, to begin with, or the "
        f"name of a shipped checkpoint ({', '.join(SHIPPED)}); null begins with random or published weights.",
        examples=["lit"],
    )
    stages: list[Stage] = Field(default=THREE_STAGES, min_length=1, description="The curriculum, in order.")
    optimizer: OptimizerSettings = OptimizerSettings()
    loss: LossSettings = LossSettings()
    data: DataSettings = DataSettings()
    validation: ValidationSettings = ValidationSettings()
    logger: list[LoggerName] = Field(
        default=["csv"],
        description="Loggers: csv (metrics.csv, always), tensorboard, wandb (offline); all write into "
        "output_dir.",
    )
    seed: int = Field(
        default=0, description="Root of all randomness: initial weights, batches, augmentation."
    )
    max_seconds: float | None = Field(
        default=None,
        gt=0,
        description="Anneal all stages within this training time, each by its share of the steps; "
        "null trains the given steps, reproducibly.",
    )
    checkpoint_every: int = Field(default=500, ge=1, description="Steps between checkpoints.")
    threads: int | None = Field(
        default=1,
        ge=1,
        description="CPU threads of torch; 1 makes runs reproducible bit by bit, null keeps torch's default.",
    )
    accelerator: str = Field(default="auto", description="Lightning accelerator: auto, cpu, gpu.")
    devices: Annotated[int, Field(ge=1)] | Literal["auto"] = Field(
        default="auto",
        description="Number of devices of this machine, one process each; auto: every GPU, or one process "
        "on the CPU.",
    )
    nodes: int = Field(
        default=1,
        ge=1,
        description="Number of machines; start the command on each, by torchrun or srun.",
    )
    precision: Precision = Field(default="32-true", description="Precision of training, as Lightning has it")
    strategy: Literal["auto", "ddp", "fsdp"] = Field(
        default="auto",
        description="How processes share the work: ddp (auto means this) keeps all weights in each; fsdp "
        "shards weights and optimiser state.",
    )
    memory: MemorySettings = MemorySettings()
    compile: bool = Field(default=False, description="Compile the transformer's blocks by torch.compile.")

    @field_validator("stages")
    @classmethod
    def _distinct_names(cls, stages: list[Stage]) -> list[Stage]:
        if len({stage.name for stage in stages}) < len(stages):
            raise ValueError("two stages have one name")
        if not any(stage.steps for stage in stages):
            raise ValueError("no stage has any steps")
        return stages

    @field_validator("splits")
    @classmethod
    def _places(cls, splits: dict[str, str]) -> dict[str, str]:
        for name, value in splits.items():
            for split in SplitPlace.parse(name, value).splits:
                _require_training_split(name, split)
        return splits

    @model_validator(mode="after")
    def _splits_are_read(self) -> Settings:
        read = {self.validation.split}.union(*(stage.splits() for stage in self.stages))
        if unread := sorted(set(self.splits) - read):
            raise ValueError(f"splits names '{unread[0]}', which neither a stage nor validation reads")
        return self

    @model_validator(mode="after")
    def _shards_follow_adamw(self) -> Settings:
        for name in ("muon_learning_rate", "ema_decay"):
            if self.strategy == "fsdp" and getattr(self.optimizer, name) is not None:
                raise ValueError(f"strategy=fsdp trains without optimizer.{name}: give null, or strategy=ddp")
        return self

    @model_validator(mode="after")
    def _test_is_held_out(self) -> Settings:
        _require_training_split("validation.split", self.validation.split)
        for stage in self.stages:
            for split in stage.splits():
                _require_training_split(f"stage {stage.name}", split)
        return self


def _require_training_split(name: str, split: str | None) -> None:
    if split is not None and (split == HELD_OUT or split.startswith(f"{HELD_OUT}_")):
        raise ValueError(
            f"{name} asks for the split '{split}', which is kept for evaluation: training never reads it"
        )


@dataclass(frozen=True)
class SplitPlace:
    """A dataset's folder or URL, and the names of its splits that are joined into one."""

    folder: str
    splits: tuple[str, ...]

    @classmethod
    def parse(cls, name: str, value: str) -> SplitPlace:
        """Parse the place of the split that a run calls ``name``: FOLDER[#SPLIT[+SPLIT...]].

        Raises:
            ValueError: the text has another form, or names a split twice.
        """
        folder, mark, joined = value.rpartition("#")
        splits = tuple(joined.split("+")) if mark else (name,)
        place = cls(folder if mark else value, splits)
        if not place.folder or not all(splits) or len(set(splits)) < len(splits):
            raise ValueError(f"{name}={value!r} is neither FOLDER nor FOLDER#SPLIT, nor FOLDER#SPLIT+OTHER")
        return place
