"""Stages and their clock: what the schedule promises at its ends and in between."""

import copy
import time
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from train.curriculum import Stage, StageClock, learning_rate_factor, require_splits
from tron.errors import TronError

STAGE = Stage(name="one", split="train", steps=1000, learning_rate=0.5, final_learning_rate=0.01)


def test_the_rate_rises_to_its_peak_falls_like_a_cosine_and_ends_where_it_should():
    rates = [learning_rate_factor(STAGE, step / 1000, step, 100) for step in range(1001)]
    assert rates[0] == pytest.approx(0.5 / 101)
    assert int(np.argmax(rates)) in range(90, 111)
    assert rates[-1] == pytest.approx(0.01)
    assert all(b < a for a, b in pairwise(rates[101:]))
    assert rates[500] == pytest.approx(0.255)  # half way between the two


def test_without_warm_up_the_first_step_is_the_peak():
    assert learning_rate_factor(STAGE, 0.0, 0, 0) == 0.5


@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.5, 1.0])
def test_single_frames_take_their_share_of_any_run_of_batches(ratio):
    stage = STAGE.model_copy(update={"frames": 5, "still_ratio": ratio})
    stills = [stage.frames_of(step) == 1 for step in range(100)]
    for start, length in ((0, 100), (7, 10), (31, 40)):
        assert abs(sum(stills[start : start + length]) - ratio * length) <= 1
    assert {stage.frames_of(step) for step in range(100)} <= {1, 5}


def test_a_pace_by_steps_ignores_the_clock():
    clock = StageClock(200)
    clock.start()
    assert [clock.progress(step) for step in (0, 50, 200, 300)] == [0.0, 0.25, 1.0, 1.0]


def test_a_pace_by_time_ignores_the_steps_and_stands_still_while_stopped():
    clock = StageClock(200, seconds_limit=10.0)
    clock.spent = 2.5  # an earlier session's
    clock.shown = clock.seconds()
    assert clock.progress(10**9) == 0.25
    clock.start()
    time.sleep(0.02)
    assert clock.progress(0) == 0.25, "nobody has looked at the clock since"
    clock.stop()
    reached = clock.seconds()
    assert 2.52 <= reached < 6
    time.sleep(0.01)
    assert clock.seconds() == reached
    clock.shown = reached
    assert clock.progress(0) == reached / 10


def test_a_copied_module_goes_by_the_same_clock():
    """Averaging copies modules; what a clock of several processes agrees with cannot be copied."""
    agree = (each for each in (1.5,))
    with pytest.raises(TypeError):
        copy.deepcopy(agree)
    clock = StageClock(10, 3.0, lambda _, told=agree: next(told))
    held = {"clock": clock, "again": [clock]}
    assert copy.deepcopy(held)["clock"] is clock
    clock.look()
    assert clock.progress(0) == 0.5


def test_all_splits_that_lack_are_named_at_once_the_first_stage_s_first():
    names = [("images", "train"), ("adapt", "train_b"), ("video", "train_b")]
    stages = [Stage(name=name, split=split, steps=1) for name, split in names]
    require_splits(stages, ["test", "train", "train_b"])
    with pytest.raises(TronError) as said:
        require_splits(stages, ["test", "train_relit"])
    assert said.value.what == (
        "no split 'train' (stage images), 'train_b' (stage adapt, video) in the dataset, which has: test, "
        "train_relit"
    )
    assert "splits={train: " in str(said.value)
    assert "splits={train_b: " in str(said.value)
    with pytest.raises(TronError, match=r"no split 'train_b' \(stage adapt, video\)"):
        require_splits(stages, ["train"])


@pytest.mark.parametrize(
    "wrong",
    [{"frames": 2}, {"frames": 4}, {"name": "Stage 1"}, {"crop": 4}, {"rehearsal_ratio": 1.5}, {"x": 1}],
)
def test_stages_that_cannot_run_are_refused(wrong):
    with pytest.raises(ValidationError):
        Stage.model_validate({"name": "one", "split": "train", "steps": 10} | wrong)


def test_a_stage_draws_from_its_rehearsal_split_only_if_it_takes_any():
    stage = Stage(name="two", split="train_b", steps=1, rehearsal_split="train")
    assert stage.splits() == ["train_b"]
    assert stage.model_copy(update={"rehearsal_ratio": 0.1}).splits() == ["train_b", "train"]
