"""tron-train: a resumed run equals an uninterrupted one bit by bit; runs are bounded and claimed."""

import csv
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import yaml
from lightning.pytorch.callbacks import ModelCheckpoint
from safetensors.torch import load_file

from train import curriculum
from train import run as training_run
from train.checkpoints import find_position
from train.cli import main
from train.curriculum import Stage, StageClock
from train.settings import Settings
from tron.errors import TronError
from tron.neural.networks.pixel_mlp import PixelMLP
from tron.neural.weights import load_renderer


@pytest.fixture(scope="session")
def train(make_settings) -> Callable[..., Path]:
    def run(dataset: Path, output: Path, **changes) -> Path:
        main(Settings.model_validate(make_settings(dataset, output, **changes)))
        return output

    return run


@pytest.fixture(scope="module")
def finished(train, dataset, tmp_path_factory) -> Path:
    return train(dataset, tmp_path_factory.mktemp("finished"))


class Killed(Exception):
    pass


def train_until(train, monkeypatch, dataset: Path, output: Path, saves: int, **changes) -> None:
    """Train, and die right after the checkpoint number `saves`, as a kill would have it."""
    saved = ModelCheckpoint._save_checkpoint
    count = 0

    def save_and_die(self, trainer, path):
        nonlocal count
        saved(self, trainer, path)
        count += 1
        if count == saves:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(ModelCheckpoint, "_save_checkpoint", save_and_die)
        with pytest.raises(Killed):
            train(dataset, output, **changes)


@pytest.mark.parametrize("saves", [1, 2, 3, 4])
def test_a_resumed_run_equals_an_uninterrupted_one_bit_by_bit(
    train, monkeypatch, dataset, finished, tmp_path, saves
):
    train_until(train, monkeypatch, dataset, tmp_path, saves)
    assert not (tmp_path / "renderer.safetensors").exists()
    train(dataset, tmp_path)
    expected = (finished / "renderer.safetensors").read_bytes()
    assert (tmp_path / "renderer.safetensors").read_bytes() == expected
    rows, expected = (
        [
            (row["stage"], row["step"], row["loss"], row["learning_rate"])
            for row in csv.DictReader(path.open())
        ]
        for path in (tmp_path / "metrics.csv", finished / "metrics.csv")
    )
    assert rows == expected


def test_resuming_holds_with_muon_an_averaged_model_and_data_read_as_needed(
    train, monkeypatch, dataset, tmp_path
):
    changes = {
        "optimizer": {"warmup_steps": 2, "ema_decay": 0.5, "muon_learning_rate": 0.02},
        "data": {"cache_gb": 0.0},
        "validation": {"split": None},
    }
    train(dataset, tmp_path / "whole", **changes)
    train_until(train, monkeypatch, dataset, tmp_path / "killed", 3, **changes)
    train(dataset, tmp_path / "killed", **changes)
    whole, killed = (load_file(tmp_path / name / "renderer.safetensors") for name in ("whole", "killed"))
    assert all(torch.equal(whole[name], killed[name]) for name in whole)


def test_training_lowers_the_loss_and_the_seed_decides_the_result(train, dataset, finished, tmp_path):
    stages = [{"name": "one", "split": "train", "steps": 60, "batch_size": 4, "crop": 16}]
    optimizer = {"learning_rate": 5e-3, "warmup_steps": 2}
    validation = {"clips": 2, "every": 30}
    train(dataset, tmp_path / "long", stages=stages, optimizer=optimizer, validation=validation)
    rows = list(csv.DictReader((tmp_path / "long" / "metrics.csv").open()))
    assert rows[-1]["val_psnr"]
    assert float(rows[-1]["loss"]) < 0.7 * float(rows[0]["loss"])
    train(dataset, tmp_path / "seed", seed=1)
    a, b = (load_file(folder / "renderer.safetensors") for folder in (finished, tmp_path / "seed"))
    assert not torch.equal(a["backbone.transformer.patch_embed.proj.weight"],
                           b["backbone.transformer.patch_embed.proj.weight"])  # fmt: skip


def test_the_codec_is_fitted_on_training_data_and_kept_with_the_weights(train, finished):
    renderer = load_renderer(finished / "renderer.safetensors")
    assert renderer.codec.mean.abs().max() > 0.1  # type: ignore[union-attr]
    assert renderer.codec.deviation.min() >= 0.02 - 1e-6  # type: ignore[union-attr]


def test_a_finished_run_is_left_as_it_is(train, dataset, finished):
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*") if path.is_file()}
    train(dataset, finished)
    after = {path: path.stat().st_mtime_ns for path in finished.rglob("*") if path.is_file()}
    lock = finished / ".tron.lock"
    assert {k: v for k, v in after.items() if k != lock} == {k: v for k, v in before.items() if k != lock}


def test_a_folder_with_another_run_is_refused(train, dataset, finished):
    with pytest.raises(TronError, match="a run made with seed=0, not"):
        train(dataset, finished, seed=5)


def test_other_data_under_the_same_settings_is_another_run(train, make_dataset, finished, tmp_path):
    other = make_dataset(tmp_path / "other", {"train": 4, "train_b": 3, "test": 2})
    with pytest.raises(TronError, match="a run made with another dataset "):
        train(other, finished)


def test_the_configuration_is_kept(train, dataset, finished):
    kept = yaml.safe_load((finished / "config.yaml").read_text())
    assert kept["optimizer"]["learning_rate"] == 1e-3
    assert [stage["name"] for stage in kept["stages"]] == ["one", "two"]
    assert len(kept["dataset_sha256"]) == 64


def test_the_pixel_mlp_trains_through_the_same_command(train, dataset, tmp_path):
    recipe = {"_target_": "tron.neural.networks.pixel_mlp.PixelMLP"}
    output = train(dataset, tmp_path, renderer=recipe)
    assert isinstance(load_renderer(output / "renderer.safetensors"), PixelMLP)


def test_max_seconds_ends_training_with_its_schedule(train, dataset, tmp_path, monkeypatch):
    """On a clock by which every step takes 1/16 s, however busy the machine is."""
    now, look = [0.0], StageClock.look

    def look_later(clock: StageClock) -> None:
        now[0] += 1 / 16
        look(clock)

    monkeypatch.setattr(curriculum, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(StageClock, "look", look_later)
    stages = [
        {"name": n, "split": "train", "steps": 1000, "batch_size": 1, "crop": 16} for n in ("one", "two")
    ]
    train(
        dataset, tmp_path, max_seconds=2.0, stages=stages, validation={"split": None}, checkpoint_every=10**6
    )
    rows = list(csv.DictReader((tmp_path / "metrics.csv").open()))
    for name in ("one", "two"):
        last = [row for row in rows if row["stage"] == name][-1]
        assert (int(last["step"]), float(last["seconds"])) == (16, 1.0)
        assert float(last["learning_rate"]) < 0.05e-3  # the cosine came to its end


def test_stages_without_steps_are_left_out(train, dataset, tmp_path):
    stages = [
        {"name": "one", "split": "train", "steps": 0},
        {"name": "two", "split": "train_b", "steps": 2, "batch_size": 1, "crop": 16},
    ]
    output = train(dataset, tmp_path, stages=stages)
    assert [path.name for path in (output / "checkpoints").iterdir()] == ["1-two.safetensors"]


def test_a_wrong_renderer_is_one_clear_line(train, dataset, tmp_path):
    fusion = {"_target_": "tron.neural.configs.RendererConfig", "fusion": "sum"}
    for target, more, message in (
        ("tron.neural.renderer.Nothing", {}, "renderer cannot be made"),
        ("tron.neural.networks.pixel_mlp.PixelMLP", {"wide": 1}, "renderer cannot be made"),
        ("builtins.dict", {}, "not a renderer"),
        ("tron.neural.weights.load_cosmos", {"transformer_path": None, "vae_path": None}, "model.pt"),
        ("tron.neural.renderer.NeuralRenderer", {"config": fusion}, r"renderer\.config\.fusion"),
    ):
        with pytest.raises(TronError, match=message) as caught:
            train(dataset, tmp_path, renderer={"_target_": target, **more})
        assert "\n" not in str(caught.value)


def test_the_newest_checkpoint_of_the_first_unfinished_stage_is_found(tmp_path):
    stages = [Stage(name=name, split="train", steps=1) for name in ("one", "two")]
    assert (find_position(tmp_path, stages).stage, find_position(tmp_path, stages).checkpoint) == (0, None)
    for name in ("1-one.safetensors", "2-two-00000040.ckpt", "2-two-00000120.ckpt", "1-one-00009999.ckpt"):
        (tmp_path / name).touch()
    position = find_position(tmp_path, stages)
    assert (position.stage, position.step) == (1, 120)
    assert position.checkpoint == tmp_path / "2-two-00000120.ckpt"
    (tmp_path / "2-two.safetensors").touch()
    assert find_position(tmp_path, stages).stage == 2


def test_a_damaged_checkpoint_is_named(train, monkeypatch, dataset, tmp_path):
    train_until(train, monkeypatch, dataset, tmp_path, 1)
    (checkpoint,) = (tmp_path / "checkpoints").glob("*.ckpt")
    checkpoint.write_bytes(checkpoint.read_bytes()[:500])
    with pytest.raises(TronError, match="checkpoint is damaged") as caught:
        train(dataset, tmp_path)
    assert checkpoint.name in str(caught.value)


def test_an_interrupt_ends_the_command_as_interrupts_do(train, monkeypatch, dataset, tmp_path):
    def interrupt(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(training_run.RendererModule, "training_step", interrupt)
    with pytest.raises(KeyboardInterrupt):
        train(dataset, tmp_path)


def test_help_and_mistyped_keys_wait_for_no_torch():
    program = (
        "import sys, train.cli; sys.exit(any(m in sys.modules for m in ('torch', 'lightning', 'diffusers')))"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
