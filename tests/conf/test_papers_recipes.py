"""The recipes named after the paper make what the paper made: its sizes, numbers of scenes and schedules."""

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from datagen.settings.command import Settings as DatagenSettings
from eval.stages import Child, Stages
from train.curriculum import learning_rate_factor
from train.optimizers import make_optimizer
from train.run import build_renderer
from train.settings import Settings as TrainSettings
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError
from tron.estimation import QUALITY
from tron.metrics import LPIPS
from tron.neural.losses import RendererLoss
from tron.neural.weights import load_cosmos
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips

SMOKE = "experiment=paper_smoke"
WAN: dict[str, Any] = {"base_dim": 8, "num_res_blocks": 1}
"""Shape of the tiny autoencoder; its latents are the published one's."""
VGG = (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512)
"""Channels of VGG-16's convolutions, M between them where it pools."""


@pytest.fixture(scope="module")
def datagen() -> DatagenSettings:
    overrides = ["experiment=paper", "output_dir=out"]
    return check(compose_recipe("conf.datagen", DatagenSettings, overrides), DatagenSettings)


@pytest.fixture(scope="module")
def train() -> TrainSettings:
    return composed_training("paper")


def composed_training(experiment: str) -> TrainSettings:
    overrides = [f"experiment={experiment}", "dataset=in", "output_dir=out", "loss.vgg_weights=vgg.pth"]
    overrides += ["renderer.transformer_path=a", "renderer.vae_path=b"]
    return check(compose_recipe("conf.train", TrainSettings, overrides), TrainSettings)


def test_the_synthetic_set_has_975_scenes_of_93_frames_under_20_lights(datagen: DatagenSettings) -> None:
    """Ten of the lights have a high contrast, ten a low one."""
    train = datagen.train
    assert (train.scenes, train.frames, train.width, train.height) == (975, 93, 512, 512)
    assert Counter(train.lights) == {"high": 10, "low": 10}


def test_the_benchmark_has_40_scenes_under_5_lights_seen_from_290_and_93_cameras(
    datagen: DatagenSettings,
) -> None:
    test = datagen.test
    assert (test.scenes, len(test.lights), test.frames) == (40, 5, 93)
    assert (datagen.views, datagen.view_width, datagen.view_height) == (290, 800, 800)
    assert (test.width, test.height) == (800, 800)
    assert datagen.path_frames == 93
    assert test.reference_buffers


def test_the_benchmark_is_tron_synth(datagen: DatagenSettings) -> None:
    overrides = ["experiment=tron_synth", "output_dir=out"]
    synth = check(compose_recipe("conf.datagen", DatagenSettings, overrides), DatagenSettings)
    assert datagen.test == synth.test
    for key in ("path_frames", "environment_height"):
        assert getattr(datagen, key) == getattr(synth, key)


def test_shadows_take_2_rays_for_a_preview_and_64_in_the_end(datagen: DatagenSettings) -> None:
    """Nothing bounces in the paper's light, and so none is baked that a preview could show."""
    assert (QUALITY["preview"].of_pixels().rays, QUALITY["final"].rays) == (2, 64)
    assert all(datagen.split(name).guidance_spp == 64 for name in datagen.used_splits())


def test_the_curriculum_has_three_stages_of_32000_steps(train: TrainSettings) -> None:
    """Synthetic 512 x 512 with one frame, then real pictures at 1024 x 576, with one and with five."""
    assert [(stage.steps, stage.frames) for stage in train.stages] == [(32_000, 1), (32_000, 1), (32_000, 5)]
    assert [stage.crop for stage in train.stages] == [512, None, None]
    assert [stage.size for stage in train.stages] == [None, (1024, 576), (1024, 576)]
    assert {stage.batch_size for stage in train.stages} == {1}
    assert (train.optimizer.learning_rate, train.optimizer.muon_learning_rate) == (2e-5, None)
    assert (train.loss.l2, train.loss.lpips) == (1.0, 1.0)


def test_nothing_is_done_that_the_paper_does_not_speak_of(train: TrainSettings) -> None:
    """A constant rate from the first step to the last, frames as they are, one split a stage."""
    optimizer, data = train.optimizer, train.data
    rates = {
        learning_rate_factor(stage, progress, step, optimizer.warmup_steps)
        for stage in train.stages
        for step, progress in ((0, 0.0), (1, 0.3), (31_999, 1.0))
    }
    assert rates == {1.0}
    assert (optimizer.gradient_clip, optimizer.ema_decay) == (None, None)
    assert (data.flip, data.permute_colors, data.tint) == (0, 0, 0)
    assert (data.exposure, data.rotate, data.mix_lights) == (0, 0, 0)
    assert train.start_from is None
    assert [stage.splits() for stage in train.stages] == [["train"], ["train_b"], ["train_b"]]
    assert {stage.still_ratio for stage in train.stages} == {0}
    assert train.max_seconds is None


def test_lpips_is_not_left_out_unseen() -> None:
    with pytest.raises(TronError, match="vgg_weights"):
        check(
            compose_recipe("conf.train", TrainSettings, ["experiment=paper", "dataset=in", "output_dir=out"]),
            TrainSettings,
        )


@pytest.mark.parametrize("experiment", ["paper", "paper_smoke"])
def test_what_is_made_fits_what_is_trained_on(experiment: str) -> None:
    """Splits, clips and frames of the two recipes of a name; the captures of the paper are the user's."""
    overrides = [f"experiment={experiment}", "output_dir=out"]
    made = check(compose_recipe("conf.datagen", DatagenSettings, overrides), DatagenSettings)
    training = composed_training(experiment)
    there = set(made.used_splits())
    assert {"train", "validation", "test"} <= there
    for stage in training.stages:
        if stage.split not in there:
            assert (experiment, stage.split) == ("paper", "train_b")
            continue
        split = made.split(stage.split)
        assert stage.frames <= split.frames
        assert stage.crop is None or stage.crop == split.width == split.height
    assert made.validation.frames >= max(stage.frames for stage in training.stages)
    held_out = made.validation
    for stage in training.stages:
        width, height = stage.size or (stage.crop, stage.crop)
        assert held_out.width >= (width or 0)
        assert held_out.height >= (height or 0)
    assert set(made.train.style) == set(made.validation.style) == {"object", "table"}


def test_the_smoke_run_is_the_papers_in_all_but_size() -> None:
    """Every key of it that differs from the paper's own is a number, a size or a machine's."""
    paper, smoke = (composed_training(name) for name in ("paper", "paper_smoke"))
    sizes = {"steps", "crop", "size"}
    assert [each.model_dump(exclude=sizes) for each in smoke.stages] == [
        each.model_dump(exclude=sizes) for each in paper.stages
    ]
    assert (smoke.optimizer, smoke.loss) == (paper.optimizer, paper.loss)
    configs = [dict(each.renderer["config"], backbone=None) for each in (paper, smoke)]
    assert configs[0] == configs[1]
    chosen = {name: smoke.renderer["config"]["backbone"][name] for name in ("patch", "padding_channel")}
    assert chosen == {name: paper.renderer["config"]["backbone"][name] for name in chosen}


def test_the_renderer_averages_the_two_latents_at_timestep_250_of_1000(train: TrainSettings) -> None:
    config = train.renderer["config"]
    assert (config["codec"], config["fusion"]) == ("wan", "average")
    assert (config["sigma"], config["window"]) == (0.25, 5)
    assert tuple(config["guidance"]) == ("pbr", "irradiance")


def test_adamw_trains_the_transformer_alone_without_its_text_branch(tmp_path) -> None:
    """The VAE is frozen, and so is what the null text embedding goes through; files of the published form."""
    write_tiny_weights(tmp_path)
    paths = [f"renderer.transformer_path={tmp_path / 'transformer'}", f"renderer.vae_path={tmp_path / 'vae'}"]
    overrides = [
        "experiment=paper_smoke",
        "dataset=in",
        "output_dir=out",
        f"loss.vgg_weights={tmp_path}/vgg16.pth",
    ]
    smoke = check(compose_recipe("conf.train", TrainSettings, [*overrides, *paths]), TrainSettings)
    renderer = build_renderer(smoke.renderer)
    optimizer = make_optimizer(renderer, smoke.optimizer)
    assert type(optimizer) is torch.optim.AdamW
    trained = {id(weight) for group in optimizer.param_groups for weight in group["params"]}
    names = {name for name, weight in renderer.named_parameters() if id(weight) in trained}
    assert all(name.startswith("backbone.transformer.") for name in names)
    text = {name for name, _ in renderer.named_parameters() if ".attn2." in name or ".norm2." in name}
    assert text
    assert not text & names
    assert names | text == {name for name, _ in renderer.named_parameters()}
    losses = RendererLoss(**smoke.loss.model_dump())
    assert losses.perceptual is not None


def write_tiny_weights(folder: Path) -> None:
    """Random weights of paper_smoke's shapes: ``transformer`` and ``vae`` (diffusers), ``vgg16.pth``."""
    from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

    from tron.neural.configs import BackboneConfig
    from tron.neural.networks.backbone import transformer

    torch.manual_seed(0)
    vae = AutoencoderKLWan(**WAN).eval()
    vae.save_pretrained(folder / "vae")
    channels = vae.config["z_dim"]
    shape = BackboneConfig.model_validate(composed_training("paper_smoke").renderer["config"]["backbone"])
    transformer(shape, channels, channels).save_pretrained(folder / "transformer")
    state = {f"features.{name}": value for name, value in _vgg16_features().state_dict().items()}
    torch.save(state, folder / "vgg16.pth")


def _vgg16_features() -> nn.Sequential:
    """Convolutions of VGG-16 at torchvision's places, random."""
    layers: list[nn.Module] = []
    channels = 3
    for each in VGG:
        if isinstance(each, str):
            layers.append(nn.MaxPool2d(2))
            continue
        layers += [nn.Conv2d(channels, each, 3, padding=1), nn.ReLU()]
        channels = each
    return nn.Sequential(*layers)


def test_tiny_weights_are_read_by_the_loaders_of_the_published_files(tmp_path):
    write_tiny_weights(tmp_path)
    backbone = {"heads": 2, "head_dim": 12, "layers": 2, "text_embed_dim": 16, "adaln_lora_dim": 8}
    backbone |= {"patch": (1, 2, 2), "max_size": (8, 32, 32), "rope_scale": (1.0, 4.0, 4.0)}
    backbone |= {"padding_channel": True, "cross_attention": "frozen"}
    renderer = load_cosmos(tmp_path / "transformer", tmp_path / "vae", {"backbone": backbone})
    assert renderer.config.fusion == "average"
    LPIPS.load(tmp_path / "vgg16.pth")


@pytest.mark.long
def test_the_papers_recipes_run_from_data_to_figures(tmp_path):
    """Data from reconstructions, three stages with LPIPS, evaluation of the network that came of it."""
    weights, dataset, trained, judged = (tmp_path / name for name in ("weights", "dataset", "train", "eval"))
    write_tiny_weights(weights)
    training = [
        *(SMOKE, f"dataset={dataset}", f"loss.vgg_weights={weights / 'vgg16.pth'}"),
        *(f"renderer.transformer_path={weights / 'transformer'}", f"renderer.vae_path={weights / 'vae'}"),
    ]
    judging = [
        f"dataset={dataset}",
        f"renderer={trained / 'renderer.safetensors'}",
        f"+benchmark.vae={weights / 'vae'}",
    ]
    stages = Stages(tmp_path)
    for script, arguments, output in (
        ("tron-datagen", [SMOKE, "cluster=none"], dataset),
        ("tron-train", training, trained),
        ("tron-eval", judging, judged),
    ):
        stages.run(script, [Child(script, script, [*arguments, f"output_dir={output}"])])
    manifest = Manifest.load(dataset)
    clips = {split: sum(e.samples for e in manifest.of_split(split)) for split in manifest.splits()}
    assert clips == {"train": 4, "train_b": 1, "validation": 1, "test": 2}
    rows = {row["metric"]: row["value"] for row in json.loads((judged / "results.json").read_text())["rows"]}
    assert math.isfinite(rows["neural.psnr"])
    made = {
        clip.meta.extra["surfels_from"] for split in clips for clip in read_clips(dataset, split, ["pbr"])
    }
    assert made == {"reconstruction"}
    steps = (trained / "metrics.csv").read_text()
    assert all(stage in steps for stage in ("synthetic", "adapt", "video"))
