"""The stages of training as plain data, and the learning rate within a stage."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, field_validator

from tron.errors import TronError
from tron.neural.clips import TEMPORAL_FACTOR

FrameSide = Annotated[int, Field(ge=8, le=16_384)]
CAPTURES = "train_b"
"""Split of reconstructed captures, or of path-traced scenes used in their place."""


class Stage(BaseModel):
    """One stage of the curriculum: its data and its length."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,40}$", description="Name in logs and checkpoint files.")
    split: str = Field(description="Split of the dataset to train on.")
    frames: int = Field(default=1, ge=1, description="Frames K of a sample, 1 + 4n, consecutive in a clip.")
    steps: int = Field(
        ge=0,
        description="Optimiser steps; with max_seconds, this stage's share of the time. 0 skips the stage.",
    )
    batch_size: int = Field(default=8, ge=1, description="Samples per step, on each device.")
    crop: int | None = Field(
        default=None, ge=8, description="Side of the random square crop, pixels; null trains on whole frames."
    )
    size: tuple[FrameSide, FrameSide] | None = Field(
        default=None,
        description="Width and height, pixels: frames are reduced by area averaging until they just cover "
        "this size, then a random window of this size is taken, before the crop; validation "
        "takes the centre. null: frames are not reduced.",
    )
    learning_rate: float = Field(
        default=1.0, gt=0, description="Factor on the optimizer's learning rates at the stage's peak."
    )
    final_learning_rate: float = Field(
        default=0.01,
        gt=0,
        description="Factor on the optimizer's learning rates at the stage's end, after a cosine.",
    )
    still_ratio: float = Field(
        default=0.0, ge=0, le=1, description="Share of a video stage's batches that hold single frames."
    )
    rehearsal_split: str | None = Field(
        default=None, description="Earlier split to mix in, against forgetting."
    )
    rehearsal_ratio: float = Field(
        default=0.0, ge=0, le=1, description="Fraction of samples that come from rehearsal_split."
    )

    @field_validator("frames")
    @classmethod
    def _codec_frames(cls, value: int) -> int:
        if (value - 1) % TEMPORAL_FACTOR:
            raise ValueError("frames must be 1 + 4n: 1, 5, 9, ...")
        return value

    def frames_of(self, step: int) -> int:
        """Number of frames K in a step's batch: single-frame batches are spread evenly over a video stage."""
        stills = math.floor((step + 1) * self.still_ratio) - math.floor(step * self.still_ratio)
        return 1 if stills else self.frames

    def splits(self) -> list[str]:
        """Splits that this stage draws from."""
        return [self.split] + (
            [self.rehearsal_split] if self.rehearsal_split and self.rehearsal_ratio else []
        )


def require_splits(stages: Sequence[Stage], there: Sequence[str]) -> None:
    """Check that the dataset has every split of a curriculum.

    Raises:
        TronError: splits are missing; it names all of them, in the order of the stages.
    """
    lacking: dict[str, list[str]] = {}
    for stage in stages:
        for split in stage.splits():
            if split not in there:
                lacking.setdefault(split, []).append(stage.name)
    if not lacking:
        return
    named = [f"'{split}' (stage {', '.join(names)})" for split, names in lacking.items()]
    mends = []
    if lacking.keys() - {CAPTURES}:
        first = next(split for split in lacking if split != CAPTURES)
        mends.append(f"say where splits are: 'splits={{{first}: \"FOLDER#SPLIT\"}}'")
    if CAPTURES in lacking:
        mends.append(
            f"'{CAPTURES}' is of captures, made by tron-datagen source=captured: "
            f"'splits={{{CAPTURES}: \"FOLDER#train\"}}'; or make a dataset with {CAPTURES}.scenes above 0 to "
            "stand in"
        )
    raise TronError(
        f"no split {', '.join(named)} in the dataset, which has: {', '.join(there)}",
        mend="; ".join(mends),
    )


class StageClock:
    """Progress of a stage from 0 to 1: by its steps, or by its share of a time limit.

    By steps, a run is reproducible. By time, the schedule anneals to its end within the limit on any machine,
    and the number of steps depends on the machine. Time counts only while the stage runs; `seconds` is the
    time spent by earlier sessions of a resumed run. Progress follows the last reading of the clock; processes
    that train together all read the first one's time (`agreed`).
    """

    def __init__(
        self,
        steps: int,
        seconds_limit: float | None = None,
        agreed: Callable[[float], float] = lambda seconds: seconds,
    ):
        self.steps = steps
        self.seconds_limit = seconds_limit
        self._agreed = agreed
        self.spent = 0.0
        self.shown = 0.0
        self._since: float | None = None

    def __deepcopy__(self, memo: dict[int, object]) -> StageClock:
        """Return the clock itself: the module's copy with averaged weights must follow the same time.

        The other processes, with which `agreed` synchronises, cannot be copied either.
        """
        return self

    def start(self) -> None:
        """Start the clock."""
        self._since = time.monotonic()

    def stop(self) -> None:
        """Stop the clock."""
        self.spent, self._since = self.seconds(), None

    def look(self) -> None:
        """Read the time; this step's learning rate and the stage's end follow from the reading."""
        if self.seconds_limit is not None:
            self.shown = self._agreed(self.seconds())

    def seconds(self) -> float:
        """Seconds of training in this stage, earlier sessions included."""
        return self.spent + (0.0 if self._since is None else time.monotonic() - self._since)

    def progress(self, step: int) -> float:
        """Fraction of the stage completed after `step` steps."""
        done = step / self.steps if self.seconds_limit is None else self.shown / self.seconds_limit
        return min(1.0, done)


def learning_rate_factor(stage: Stage, progress: float, step: int, warmup_steps: int) -> float:
    """Linear warm-up over the first steps times a half cosine from the stage's peak to its final rate."""
    warmup = min(1.0, (step + 1) / (warmup_steps + 1))
    peak, final = stage.learning_rate, stage.final_learning_rate
    return warmup * (final + (peak - final) * 0.5 * (1 + math.cos(math.pi * progress)))
