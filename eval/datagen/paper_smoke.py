"""The paper's own files, small: data, three stages of training and evaluation, as a user types them.

Weights of the paper's kind are needed and cannot be shipped: random ones of a narrow shape, in the formats of
the published files, are read by the loader that reads the published files.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from eval.results import Row
from eval.stages import Child, Stages, script_path
from tron.report.page import Section, Table
from tron.shards.manifest import Manifest

if TYPE_CHECKING:
    from torch import nn

EXPERIMENT = "experiment=paper_smoke"
WAN: dict[str, Any] = {"base_dim": 8, "num_res_blocks": 1}
"""Shape of the tiny autoencoder; its latents are the published one's."""
VGG = (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512)
"""Channels of VGG-16's convolutions, M between them where it pools."""


@dataclass(frozen=True)
class PaperSmoke:
    """One run of everything.

    Attributes:
        seconds: of each command by its name, wall time.
        clips: of each split that was made.
        psnr: metric -> dB of the evaluation; of a network with random weights, it judges nothing.
    """

    seconds: dict[str, float]
    clips: dict[str, int]
    psnr: dict[str, float]

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """The seconds of all commands together."""
        yield Row(metric="paper_smoke.seconds", value=sum(self.seconds.values()), unit="s", n=1)

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """Commands and their seconds."""
        rows = [[name, f"{seconds:.1f} s"] for name, seconds in self.seconds.items()]
        clips = ", ".join(f"{count} of {split}" for split, count in self.clips.items())
        caption = (
            f"The paper's recipes at 64 x 64 through every command: {clips} clips, three stages of training "
            "on tiny random weights in the published files' formats, and evaluation on the test split."
        )
        return [
            Section("paper_smoke", "The paper's recipes, small", [Table(caption, ["", "wall time"], rows)])
        ]


def measure_paper_smoke(folder: Path) -> PaperSmoke:
    """Make the data, train and evaluate, from nothing; the folder's former content is removed.

    Raises:
        StageFailed: a command failed.
    """
    shutil.rmtree(folder, ignore_errors=True)
    weights, dataset, trained = (folder / name for name in ("weights", "dataset", "train"))
    write_tiny_weights(weights)
    renderer = trained / "renderer.safetensors"
    training = [
        EXPERIMENT,
        f"renderer.transformer_path={weights / 'transformer'}",
        f"renderer.vae_path={weights / 'vae'}",
        f"loss.vgg_weights={weights / 'vgg16.pth'}",
        f"dataset={dataset}",
        f"output_dir={trained}",
    ]
    judging = [f"dataset={dataset}", f"renderer={renderer}", f"+benchmark.vae={weights / 'vae'}"]
    stages = Stages(folder)
    making = [EXPERIMENT, "cluster=none", f"output_dir={dataset}"]
    stages.run("datagen", [Child("datagen", "tron-datagen", making)])
    stages.run("train", [Child("train", "tron-train", training)])
    stages.run("eval", [Child("eval", "tron-eval", [*judging, f"output_dir={folder / 'eval'}"])])
    found = json.loads((folder / "eval" / "results.json").read_text("utf-8"))
    psnr = {row["metric"]: row["value"] for row in found["rows"] if row["metric"].endswith(".psnr")}
    manifest = Manifest.load(dataset)
    clips = {split: sum(e.samples for e in manifest.of_split(split)) for split in manifest.splits()}
    return PaperSmoke({name: record.seconds for name, record in stages.records.items()}, clips, psnr)


def write_tiny_weights(folder: Path) -> None:
    """Random weights of paper_smoke's shapes: ``transformer`` and ``vae`` (diffusers), ``vgg16.pth``."""
    import torch
    from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

    from tron.neural.backbone import transformer
    from tron.neural.configs import BackboneConfig

    torch.manual_seed(0)
    vae = AutoencoderKLWan(**WAN).eval()
    vae.save_pretrained(folder / "vae")
    channels = vae.config["z_dim"]
    shape = BackboneConfig.model_validate(_training_recipe()["renderer"]["config"]["backbone"])
    transformer(shape, channels, channels).save_pretrained(folder / "transformer")
    state = {f"features.{name}": value for name, value in _vgg16_features().state_dict().items()}
    torch.save(state, folder / "vgg16.pth")


def _training_recipe() -> dict[str, Any]:
    """Recipe of the training, as tron-train understands it."""
    command = [
        script_path("tron-train"),
        EXPERIMENT,
        "dataset=.",
        "output_dir=.",
        "loss.vgg_weights=.",
        "--cfg",
        "job",
    ]
    return yaml.safe_load(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def _vgg16_features() -> nn.Sequential:
    """Convolutions of VGG-16 at torchvision's places, random."""
    from torch import nn

    layers: list[nn.Module] = []
    channels = 3
    for each in VGG:
        if isinstance(each, str):
            layers.append(nn.MaxPool2d(2))
            continue
        layers += [nn.Conv2d(channels, each, 3, padding=1), nn.ReLU()]
        channels = each
    return nn.Sequential(*layers)
