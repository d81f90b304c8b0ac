"""Damaged samples: the next of their stream stand in, counted and named; too many end the run."""

import csv
import itertools
import shutil
from pathlib import Path

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from safetensors.torch import load_file
from torch.utils.data import DataLoader

from train.cli import main
from train.curriculum import Stage
from train.examples.data import DAMAGED, Batches, TrainingData
from train.examples.sources import CachedSplit, IndexedSplit, Passes
from train.settings import DataSettings, Settings, ValidationSettings
from tron.errors import TronError
from tron.shards import GUIDANCE, ClipStore
from tron.shards.schema import TARGET

MEMBERS = (*GUIDANCE, TARGET)
STAGE = Stage(name="one", split="train", steps=10, batch_size=3, crop=16)
CLIPS = STAGE.model_copy(update={"frames": 5})
STEPS = 8


@pytest.fixture
def damaged(dataset, tmp_path, damage_frame) -> Path:
    """The dataset with one frame of clip 1 damaged, and the metadata of clip 3."""
    folder = tmp_path / "damaged"
    shutil.copytree(dataset, folder)
    damage_frame(folder, "train001-l0.f02.irradiance.exr")
    damage_frame(folder, "train003-l0.meta.json")
    return folder


def batches(folder: Path, kind: type[IndexedSplit], stage: Stage = STAGE, workers: int = 0, **ranks):
    source = kind(ClipStore(folder, "train"), "train", MEMBERS, 0)
    stream = Batches(stage, {"train": source}, MEMBERS, DataSettings(), 0, **ranks)
    return list(itertools.islice(iter(DataLoader(stream, batch_size=None, num_workers=workers)), STEPS))


def same(a: list[dict], b: list[dict]) -> bool:
    return all(
        torch.equal(x[name], y[name]) for x, y in zip(a, b, strict=True) for name in (*MEMBERS, DAMAGED)
    )


@pytest.mark.parametrize("stage", [STAGE, CLIPS])
def test_only_samples_of_damaged_frames_are_replaced_alike_from_memory_and_from_disk(dataset, damaged, stage):
    whole, found = batches(dataset, CachedSplit, stage), batches(damaged, CachedSplit, stage)
    assert same(found, batches(damaged, IndexedSplit, stage))
    assert same(found, batches(damaged, IndexedSplit, stage, workers=2))
    passes = Passes(0, "train", 5)
    counted = 0
    for step, place in itertools.product(range(STEPS), range(stage.batch_size)):
        clip = passes.clip(step * stage.batch_size + place)
        equal = torch.equal(found[step][TARGET][place], whole[step][TARGET][place])
        assert equal or clip in (1, 3)
        assert not (equal and clip == 3)
        counted += not equal
    assert sum(int(batch[DAMAGED]) for batch in found) == counted > 0
    assert sum(int(batch[DAMAGED]) for batch in whole) == 0


def test_ranks_replace_what_one_process_does(damaged):
    one = batches(damaged, IndexedSplit, STAGE.model_copy(update={"batch_size": 6}))
    two = [batches(damaged, IndexedSplit, rank=rank, ranks=2) for rank in (0, 1)]
    for step, batch in enumerate(one):
        assert torch.equal(batch[TARGET], torch.cat([rank[step][TARGET] for rank in two]))
        assert batch[DAMAGED] == sum(rank[step][DAMAGED] for rank in two)


def test_each_damaged_clip_is_named_once(damaged, caplog):
    batches(damaged, IndexedSplit)
    for key in ("train001-l0", "train003-l0"):
        assert caplog.text.count(f"clip {key} is damaged") == 1


def test_a_run_counts_damaged_samples_in_its_log_and_resumes_with_them(
    damaged, make_settings, tmp_path, monkeypatch
):
    def run(output: Path, **changes) -> list[dict[str, str]]:
        settings = make_settings(damaged, output, data={"cache_gb": 0.0}, **changes)
        main(Settings.model_validate(settings))
        return list(csv.DictReader((output / "metrics.csv").open()))

    rows = run(tmp_path / "whole")
    counts = [(row["stage"], int(row["damaged"])) for row in rows]
    assert counts == sorted(counts), "of a stage so far"
    assert counts[-1][1] > 0

    save = ModelCheckpoint._save_checkpoint

    def save_and_die(self, trainer, path):
        save(self, trainer, path)
        raise InterruptedError

    with monkeypatch.context() as patch:
        patch.setattr(ModelCheckpoint, "_save_checkpoint", save_and_die)
        with pytest.raises(InterruptedError):
            run(tmp_path / "killed")
    again = run(tmp_path / "killed")
    assert [row["damaged"] for row in again] == [row["damaged"] for row in rows]
    whole, killed = (load_file(tmp_path / name / "renderer.safetensors") for name in ("whole", "killed"))
    assert all(torch.equal(whole[name], killed[name]) for name in whole)


def test_more_than_the_limit_ends_the_run_with_one_line(damaged, make_settings, tmp_path):
    settings = make_settings(damaged, tmp_path / "out", data={"damaged_limit": 0.0})
    with pytest.raises(
        TronError, match=r"stage one: \d of \d+ samples were damaged.*damaged_limit=0"
    ) as said:
        main(Settings.model_validate(settings))
    assert "\n" not in str(said.value)


def test_a_damaged_validation_clip_is_left_out_of_its_windows_alone(dataset, tmp_path, damage_frame, caplog):
    folder = tmp_path / "copy"
    shutil.copytree(dataset, folder)
    damage_frame(folder, "validation001-l0.f03.rgb.exr")

    def shown(cache_gb: float, batch_pixels: int) -> torch.Tensor:
        settings = ValidationSettings(batch_pixels=batch_pixels)
        data = TrainingData(folder, DataSettings(cache_gb=cache_gb), 0, settings)
        data.begin(STAGE, 0)
        return torch.cat([batch[TARGET] for batch in data.val_dataloader()])

    first = shown(4.0, 10**9)
    assert len(first) == 6 + 5
    assert torch.equal(first, shown(0.0, 10**9))
    assert torch.equal(first, shown(0.0, 1))
    assert "Validation without frames of clip validation001-l0" in caplog.text
