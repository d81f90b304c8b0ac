"""Validation in batches of bounded size: the figures do not know how it was done."""

from pathlib import Path

import pytest
import torch

from train.curriculum import Stage, StageClock
from train.examples.data import TrainingData
from train.examples.held_out import HeldOutClips, Windows, spread
from train.module import RendererModule
from train.settings import DataSettings, OptimizerSettings, ValidationSettings
from tron.errors import TronError
from tron.neural.losses import RendererLoss
from tron.neural.networks.pixel_mlp import PixelMLP
from tron.shards import GUIDANCE, ClipStore
from tron.shards.schema import TARGET

STAGE = Stage(name="one", split="train", steps=10)
CLIPS = Stage(name="two", split="train", frames=5, steps=10)


@pytest.fixture(scope="module")
def long(make_dataset, tmp_path_factory) -> Path:
    return make_dataset(tmp_path_factory.mktemp("long"), {"validation": 2}, frames=13, size=16, width=24)


def held_out(folder: Path, budget: float) -> HeldOutClips:
    return HeldOutClips(ClipStore(folder, "validation"), [0, 1], (*GUIDANCE, TARGET), budget)


def psnr(windows: Windows) -> tuple[list[float], int]:
    """Means over the frames, foreground and full, and the most pixels that went through at a time."""
    torch.manual_seed(0)
    module = RendererModule(PixelMLP(), RendererLoss(), OptimizerSettings())
    module.begin(windows.stage, StageClock(1))
    largest = 0
    with torch.no_grad():
        for batch in windows:
            largest = max(largest, batch["mask"].numel())
            module.validation_step(batch, 0)
    return (module._psnr[:, 0] / module._psnr[:, 1]).tolist(), largest


@pytest.mark.parametrize("stage", [STAGE, CLIPS])
def test_figures_are_the_same_in_batches_of_any_size_from_memory_and_from_disk(long, stage):
    whole, largest = psnr(Windows(held_out(long, 1e9), stage, 10**9))
    assert largest == 13 // stage.frames * stage.frames * 16 * 24
    for bound in (1, 1000, 2500):
        for budget in (0, 1e9):
            means, largest = psnr(Windows(held_out(long, budget), stage, bound))
            assert means == pytest.approx(whole, abs=1e-4)
            assert largest <= max(bound, stage.frames * 16 * 24)


def test_windows_in_small_batches_are_those_of_the_whole_clip(long):
    one, many = (list(Windows(held_out(long, 0), CLIPS, bound)) for bound in (1, 10**9))
    assert (len(one), len(many)) == (4, 2)
    for name in many[0]:
        parts, whole = (torch.cat([batch[name] for batch in batches]) for batches in (one, many))
        assert torch.equal(parts, whole), name


def test_what_does_not_fit_is_read_as_used_and_nothing_of_it_kept(long):
    clips = held_out(long, 0)
    list(Windows(clips, STAGE, 1000))
    assert not clips.in_memory
    assert clips._decoded == {}
    kept = held_out(long, clips.bytes)
    list(Windows(kept, STAGE, 1000))
    assert kept.in_memory
    held = sum(image.nbytes for clip in kept._decoded.values() for image in clip.frames.values())
    assert held == kept.bytes


def test_a_stage_with_a_size_is_validated_at_it(long):
    stage = STAGE.model_copy(update={"size": (12, 12)})
    for batch in Windows(held_out(long, 1e9), stage, 500):
        assert batch[TARGET].shape[-2:] == batch["mask"].shape[-2:] == (12, 12)
        assert set(batch["mask"].unique().tolist()) <= {0.0, 1.0}


def test_a_clip_shorter_than_a_window_is_left_out(long):
    stage = STAGE.model_copy(update={"frames": 17})
    assert list(Windows(held_out(long, 1e9), stage, 10**9)) == []


def test_a_size_that_validation_cannot_serve_fails_before_training(make_dataset, tmp_path):
    folder = make_dataset(tmp_path, {"train": 1, "validation": 1}, size=16)
    for changes, message in (
        ({"size": (24, 16)}, r"frames of 16 x 16 are smaller than the stage's size, 24 x 16"),
        ({"size": (12, 8), "crop": 12}, "crops 12 pixels of 12 x 8"),
    ):
        data = TrainingData(folder, DataSettings(), 0, ValidationSettings())
        with pytest.raises(TronError, match=message):
            data.open([STAGE.model_copy(update=changes)])


def test_clips_are_spread_from_the_first_to_the_last():
    assert spread(10, 3) == [0, 4, 9]
    assert spread(3, 8) == [0, 1, 2]
    assert spread(1, 8) == [0]
