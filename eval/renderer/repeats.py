"""Repetitions under other seeds: of inference, where nothing may change, and of training.

The networks draw nothing: a seed of inference is torch's global one, and the buffers are the same. (The
``seed`` of tron-relight draws the rays of the buffers themselves.)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from eval.relighting.buffers import MEMBERS, Buffers
from eval.renderer.datasets import TEST, WEIGHTS, Datasets
from eval.renderer.frames import FramePsnr, frame_psnr
from eval.renderer.networks import Network, load_networks
from eval.renderer.settings import Kind, SeedSettings
from eval.results import Row
from tron.report.page import Block, Section, Table, Text
from tron.seeds import integer
from tron.shards.reader import read_clips


@dataclass(frozen=True)
class Repeats:
    """Findings.

    Attributes:
        differences: checkpoint -> largest difference of any display value between any two seeds.
        seeds: of inference, their number.
        clips: that were rendered.
        trained: seed of a training -> PSNR of each frame.
    """

    differences: Mapping[Kind, float]
    seeds: int
    clips: int
    trained: Mapping[int, FramePsnr]

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Largest difference, and spread of the trainings' mean PSNR."""
        for kind, value in self.differences.items():
            yield Row(metric=f"renderer.{kind}.seed_max_difference", value=value, unit="abs", n=self.seeds)
        if self.differences:
            worst = max(self.differences.values())
            yield Row(metric="renderer.seed_max_difference", value=worst, unit="abs", n=self.seeds)
        means = list(self._means().values())
        if len(means) > 1:
            spread, reach = float(np.std(means, ddof=1)), max(means) - min(means)
            yield Row(metric="renderer.training_seed_spread_db", value=spread, unit="dB", n=len(means))
            yield Row(metric="renderer.training_seed_range_db", value=reach, unit="dB", n=len(means))

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """The differences, and a row for each training."""
        blocks: list[Block] = [
            Text(
                f"{self.clips} clips rendered under {self.seeds} seeds of torch from the same buffers: "
                "largest difference of a display value "
                + ", ".join(f"{value:g} ({kind})" for kind, value in self.differences.items())
                + ". The networks draw nothing; the seed of tron-relight draws the rays of the buffers."
            )
        ]
        if self.trained:
            rows = [[f"seed {seed}", f"{mean:.2f}"] for seed, mean in self._means().items()]
            caption = "Short trainings that differ in their seed alone: mean foreground PSNR, dB."
            blocks.append(Table(caption, ["Training", "PSNR"], rows))
        return [Section("seeds", "Other seeds", blocks)]

    def _means(self) -> dict[int, float]:
        return {seed: float(np.mean([psnr for _, psnr in found])) for seed, found in self.trained.items()}


def measure_repeats(
    settings: SeedSettings, seed: int, dataset: Path, networks: Mapping[Kind, Network], made: Datasets
) -> Repeats:
    """Render under several seeds, and train under several.

    Args:
        settings: numbers and the short training's recipe.
        seed: of the inference seeds.
        dataset: whose test split judges.
        networks: checkpoints.
        made: makes the training data.

    Raises:
        StageFailed: a training failed.
    """
    clips = [Buffers.of(clip) for clip in islice(read_clips(dataset, TEST, MEMBERS), settings.clips)]
    seeds = [integer(seed, "eval", "inference", k, bits=63) for k in range(settings.inference)]
    differences: dict[Kind, float] = {
        kind: _difference(network, clips, seeds) for kind, network in networks.items()
    }
    trained: dict[int, FramePsnr] = {}
    if settings.training:
        data = made.seeds()
        runs = {
            f"seed_{each}": [*settings.recipe, f"dataset={data}", f"seed={each}"]
            for each in settings.training
        }
        folders = made.train("seeds", runs, settings.side_by_side)
        for each in settings.training:
            path = folders[f"seed_{each}"] / WEIGHTS
            show = _trained(path).show(1)
            trained[each] = frame_psnr(dataset, TEST, {"network": show})["network"]
    return Repeats(differences, len(seeds), len(clips), trained)


def _trained(path: Path) -> Network:
    """A network of whatever buffers."""
    from tron.neural.weights import load_renderer

    kind: Kind = "lit" if "lit" in load_renderer(path).config.guidance else "pair"
    return load_networks({kind: path})[kind]


def _difference(network: Network, clips: list[Buffers], seeds: list[int]) -> float:
    """Largest absolute difference between the first seed's pictures and those of any other."""
    import torch

    worst = 0.0
    for buffers in clips:
        shown = []
        for seed in seeds:
            torch.manual_seed(seed)
            shown.append(network.clip(buffers, 1))
        worst = max(worst, *(float(np.abs(image - shown[0]).max()) for image in shown))
    return worst
