"""A Cosmos renderer is trained alike whatever saves its memory: recomputed, bf16, compiled, in shards."""

import csv
import os
import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan
from pydantic import ValidationError
from safetensors.torch import load_file
from torch._inductor import config as inductor_config

from train.cli import main
from train.settings import Settings
from train.transformer_options import apply_options, transformer_blocks
from tron.errors import TronError
from tron.neural.configs import COSMOS_0_6B, BackboneConfig
from tron.neural.networks.backbone import transformer
from tron.neural.networks.pixel_mlp import PixelMLP
from tron.neural.weights import load_cosmos

two_cores = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="two processes need two cores")

NARROW: dict[str, Any] = {
    "heads": 2,
    "head_dim": 12,
    "layers": 2,
    "text_embed_dim": 16,
    "adaln_lora_dim": 8,
    "max_size": [8, 32, 32],
}
BACKBONE = BackboneConfig.model_validate(COSMOS_0_6B.model_dump() | NARROW)


@pytest.fixture(scope="module")
def published(tmp_path_factory) -> Path:
    """Random weights of the published layout, narrow: a transformer whose every weight matters, and a VAE."""
    folder = tmp_path_factory.mktemp("published")
    torch.manual_seed(0)
    transformer(BACKBONE, 16, 16).save_pretrained(folder / "transformer")
    AutoencoderKLWan(base_dim=8, num_res_blocks=1).save_pretrained(folder / "vae")
    return folder


@pytest.fixture(scope="module")
def clips(tmp_path_factory, make_dataset) -> Path:
    return make_dataset(tmp_path_factory.mktemp("clips"), {"train": 3, "validation": 1}, frames=5, size=32)


@pytest.fixture
def train(make_settings, clips, published, tmp_path) -> Callable[..., Path]:
    """Train for a few steps of frames, then of clips; gives the folder of the run."""

    def run(name: str, **changes) -> Path:
        recipe = {
            "_target_": "tron.neural.weights.load_cosmos",
            "transformer_path": str(published / "transformer"),
            "vae_path": str(published / "vae"),
            "config": {
                "_target_": "tron.neural.configs.CosmosConfig",
                "backbone": BACKBONE.model_dump(mode="json"),
            },
        }
        stages = [
            {"name": "one", "split": "train", "steps": 4, "batch_size": 1, "crop": 32},
            {"name": "two", "split": "train", "frames": 5, "steps": 2, "batch_size": 1, "crop": 32},
        ]
        settings = make_settings(clips, tmp_path / name, renderer=recipe, stages=stages)
        main(Settings.model_validate(settings | {"validation": {"every": 4, "clips": 1}} | changes))
        return tmp_path / name

    return run


def weights(run: Path) -> dict[str, torch.Tensor]:
    return load_file(run / "renderer.safetensors")


def losses(run: Path) -> list[float]:
    return [float(row["loss"]) for row in csv.DictReader((run / "metrics.csv").open())]


def largest_difference(one: Path, other: Path) -> float:
    a, b = weights(one), weights(other)
    assert a.keys() == b.keys()
    difference = max(float((a[name] - b[name]).abs().max()) for name in a)
    print(f"{other.name} from {one.name}: largest difference of a weight {difference:.2e}")
    return difference


def test_recomputed_blocks_train_the_same_weights_and_the_text_branch_stays(train, published):
    plain = train("plain")
    recomputed = train("recomputed", memory={"checkpoint_activations": True})
    assert largest_difference(plain, recomputed) < 1e-6
    assert losses(recomputed) == pytest.approx(losses(plain), rel=1e-5)
    before = load_file(published / "transformer" / "diffusion_pytorch_model.safetensors")
    after = {name.removeprefix("backbone.transformer."): w for name, w in weights(plain).items()}
    text = {name for name in before if ".attn2." in name or ".norm2." in name}
    assert len(text) == 2 * 8
    for name in before:
        assert torch.equal(before[name], after[name]) == (name in text), name


def test_recomputed_blocks_keep_a_small_part_of_the_activations(make_settings, clips, live_memory):
    def peak(layers: int, checkpointed: bool) -> int:
        torch.manual_seed(0)
        model = transformer(BACKBONE.model_copy(update={"layers": layers}), 16, 16)
        memory = {"checkpoint_activations": checkpointed}
        apply_options(model, Settings.model_validate(make_settings(clips, "out", memory=memory)))
        model.requires_grad_(False)  # gradients of weights are as large either way
        latent = torch.randn(1, 17, 2, 16, 16, requires_grad=True)
        with live_memory() as live:
            shown = model(latent, torch.tensor([0.2]), torch.zeros(1, 1, 16), return_dict=False)[0]
            shown.square().mean().backward()
        return live.peak

    more = {checkpointed: peak(8, checkpointed) - peak(2, checkpointed) for checkpointed in (False, True)}
    print(f"six more layers: {more[False]} bytes, recomputed {more[True]}")
    assert more[True] < 0.1 * more[False]


def test_bf16_trains_near_what_float32_does(train):
    plain, mixed = train("plain"), train("bf16", precision="bf16-mixed")
    assert losses(mixed) == pytest.approx(losses(plain), rel=0.02)
    assert 0 < largest_difference(plain, mixed) < 2e-2  # the rate is 1e-3, for six steps
    assert {w.dtype for w in weights(mixed).values()} == {torch.float32}


@pytest.mark.long
def test_compiled_blocks_train_the_same_weights(train):
    plain = train("plain")
    compiled = train("compiled", compile=True, memory={"checkpoint_activations": True})
    assert largest_difference(plain, compiled) < 1e-4
    assert losses(compiled) == pytest.approx(losses(plain), rel=1e-4)


def test_a_compiler_that_is_not_there_is_one_line_before_anything_is_written(train, monkeypatch, tmp_path):
    torch._dynamo.reset()
    for cached in ("TORCHINDUCTOR_CACHE_DIR", "TRITON_CACHE_DIR"):
        monkeypatch.setenv(cached, str(tmp_path / "cache"))
    monkeypatch.setattr(inductor_config.cpp, "cxx", (None, str(tmp_path / "no-compiler")))
    with pytest.raises(TronError, match=r"torch\.compile does not work") as caught:
        train("out", compile=True)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_a_renderer_without_a_transformer_has_nothing_to_recompute(make_settings, clips):
    settings = make_settings(clips, "out", memory={"checkpoint_activations": True}, compile=True)
    message = "memory.checkpoint_activations and compile need a transformer"
    with pytest.raises(TronError, match=message):
        apply_options(PixelMLP(), Settings.model_validate(settings))


def test_blocks_are_found_wherever_they_are(published):
    renderer = load_cosmos(published / "transformer", published / "vae", {"backbone": BACKBONE.model_dump()})
    assert len(transformer_blocks(renderer)) == 2
    assert transformer_blocks(PixelMLP()) == []


@two_cores
@pytest.mark.long
def test_shards_train_the_weights_of_ddp(train):
    ddp = train("ddp", devices=2, strategy="ddp")
    fsdp = train("fsdp", devices=2, strategy="fsdp")
    assert largest_difference(ddp, fsdp) < 1e-5
    assert losses(fsdp) == pytest.approx(losses(ddp), rel=1e-5)


@two_cores
@pytest.mark.long
def test_shards_go_on_from_a_checkpoint(train, tmp_path):
    """The checkpoint of step 2 is put aside while it is there."""
    aside = tmp_path / "again" / "checkpoints"
    aside.mkdir(parents=True)

    def put_aside() -> None:
        checkpoint = tmp_path / "whole" / "checkpoints" / "1-one-00000002.ckpt"
        while not (found.is_set() or (tmp_path / "whole" / "renderer.safetensors").exists()):
            with suppress(FileNotFoundError):
                shutil.copyfile(checkpoint, aside / checkpoint.name)
                found.set()

    found = threading.Event()
    watcher = threading.Thread(target=put_aside)
    watcher.start()
    how = {"devices": 2, "strategy": "fsdp", "checkpoint_every": 2}
    whole = train("whole", **how)
    watcher.join()
    assert found.is_set()
    shutil.copyfile(whole / "config.yaml", aside.parent / "config.yaml")
    again = train("again", **how)
    assert largest_difference(whole, again) == 0.0


def test_one_process_has_nothing_to_shard(train, tmp_path):
    with pytest.raises(TronError, match="and this run has one: give devices=2 or more"):
        train("out", strategy="fsdp")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["muon_learning_rate", "ema_decay"])
def test_shards_refuse_what_they_cannot_follow(make_settings, clips, name):
    settings = make_settings(clips, "out", strategy="fsdp", optimizer={name: 0.5})
    with pytest.raises(ValidationError, match=f"strategy=fsdp trains without optimizer.{name}"):
        Settings.model_validate(settings)
