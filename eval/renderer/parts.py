"""Every part of the benchmark: what it needs, and how it is measured."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

from eval.relighting.benchmark import load_network
from eval.relighting.measured import Judged
from eval.renderer.clips import measure_clips
from eval.renderer.curriculum import CAPTURES, PHOTOS, SYNTHETIC, measure_curriculum
from eval.renderer.datasets import FIT, FIT_RELIT, TEST, TEST_RELIT, WEIGHTS, Datasets
from eval.renderer.gains import Gains
from eval.renderer.judging import Judging
from eval.renderer.kills import measure_kills
from eval.renderer.networks import Network, find_weights, load_networks
from eval.renderer.projection import measure_projection
from eval.renderer.repeats import measure_repeats
from eval.renderer.settings import Kind, Part, RendererSettings
from eval.renderer.shadows import measure_shadows
from eval.renderer.sweep import measure_sweep
from eval.renderer.throughput import measure_throughput
from eval.results import Row
from tron.report.page import Section
from tron.shards.manifest import Manifest

log = logging.getLogger("tron.eval")


class Found(Protocol):
    """Findings of one part."""

    def rows(self, seed: int) -> Iterable[Row]:
        """Figures; ``seed`` draws the scenes of intervals."""
        ...

    def sections(self, pictures: Path) -> Sequence[Section]:
        """Sections of the page; pictures are also written into the folder."""
        ...


@dataclass(frozen=True)
class Parts:
    """Parts by name. Data sets and trainings are made when a part first needs them, and kept.

    Args:
        settings: of the benchmark.
        folder: for everything that is made, absolute.
    """

    settings: RendererSettings
    folder: Path

    @cached_property
    def datasets(self) -> Datasets:
        """Data sets by name."""
        return Datasets(self.settings, self.folder)

    @cached_property
    def trained(self) -> dict[Kind, Path]:
        """Folder of each checkpoint's training, where there is one."""
        return self.datasets.trained() if self.settings.train else dict(self.settings.training)

    @cached_property
    def weights(self) -> dict[Kind, Path]:
        """File of each checkpoint."""
        if self.settings.train:
            return {kind: folder / WEIGHTS for kind, folder in self.trained.items()}
        given: dict[Kind, str | None] = {"pair": self.settings.pair, "lit": self.settings.lit}
        return {kind: find_weights(each) for kind, each in given.items() if each is not None}

    @cached_property
    def networks(self) -> dict[Kind, Network]:
        """The checkpoints."""
        return load_networks(self.weights)

    def measure(self, part: Part) -> list[Found]:
        """Findings of a part; none where what it needs is not there, and the log says what.

        Raises:
            StageFailed: a command failed.
            TronError: data or weights are not what they should be.
        """
        return list(getattr(self, f"_{part}")())

    def _synthetic(self) -> Iterable[Found]:
        sizes = {size: self.datasets.synthetic(size) for size in self.settings.synthetic}
        yield Gains(
            "synthetic",
            "",
            "Held-out synthetic scenes and lights",
            "Scenes, lights and cameras of another seed than the training data's, in four styles.",
            {size: self._judged(dataset, TEST, FIT) for size, dataset in sizes.items()},
        )
        if "pair" in self.networks:
            yield measure_sweep(next(iter(sizes.values())), TEST, self.networks["pair"])

    def _models(self) -> Iterable[Found]:
        sizes: dict[int, Judged] = {}
        for size in self.settings.models:
            dataset = self.datasets.models(size)
            if dataset is None:
                log.warning("no assets and hdri in %s: no models", self.settings.real_data)
                return
            sizes[size] = self._judged(dataset, TEST, FIT)
        yield Gains(
            "models",
            "ood_",
            "Out of distribution: real models under photographed light",
            "Models and maps that nothing was trained on, alone and among other things; the baselines are "
            "fitted on other scenes of this very distribution, which favours them.",
            sizes,
        )

    def _captures(self) -> Iterable[Found]:
        dataset = self.datasets.captures()
        judged = self._judged(dataset, TEST_RELIT, FIT_RELIT)
        yield Gains(
            "captures",
            "capture_",
            "Captures, reconstructed and relit under other lights",
            "Photographs with exact masks of what is subject, reconstructed without any other truth; the "
            "reconstruction is lit by lights it was not filmed in and judged by path-traced truth. Its base "
            "color is scaled to the true maps of these views, one factor a channel, which no photo shows and "
            "no scan of yours will have.",
            {judged.clips[0].width: judged},
        )

    def _stages(self) -> Iterable[Found]:
        if not self.trained:
            log.warning("no benchmark.training={pair: DIR}: stages have no rows")
            return
        captures = self.datasets.captures()
        judges = {
            SYNTHETIC: (self.datasets.synthetic(self._size), TEST),
            CAPTURES: (captures, TEST_RELIT),
        }
        if TEST in Manifest.load(captures).splits():
            judges[PHOTOS] = (captures, TEST)
        yield measure_curriculum(self.trained, judges)

    def _clips(self) -> Iterable[Found]:
        made, settings = self.datasets.synthetic(self._size), self.settings
        yield measure_clips(
            made, TEST, self.networks, settings.clip_window, settings.overlap, settings.overlaps
        )

    def _shadows(self) -> Iterable[Found]:
        made, settings = self.datasets.shadows(), self.settings
        yield measure_shadows(made, TEST, self.networks, settings.window, settings.seed)

    def _seeds(self) -> Iterable[Found]:
        made, settings = self.datasets.synthetic(self._size), self.settings
        yield measure_repeats(settings.seeds, settings.seed, made, self.networks, self.datasets)

    def _throughput(self) -> Iterable[Found]:
        settings = self.settings
        yield measure_throughput(settings.throughput, self.networks, settings.threads, settings.seed)

    def _kills(self) -> Iterable[Found]:
        kills = self.settings.kills
        made = self.datasets.kills()
        yield measure_kills(kills.training, made, kills.count, self.settings.seed, self.folder / "killing")

    def _cosmos(self) -> Iterable[Found]:
        yield measure_projection(self.settings.cosmos_sizes, self.settings.threads)

    @property
    def _size(self) -> int:
        return next(iter(self.settings.synthetic))

    def _judged(self, dataset: Path, split: str, fit_split: str) -> Judged:
        baselines = self.datasets.pixel_mlps(dataset, fit_split)
        return Judging(
            dataset=dataset,
            split=split,
            fit_split=fit_split,
            networks=self.networks,
            trained={name: load_network(path).show for name, path in baselines.items()},
            window=self.settings.window,
            folds=self.settings.folds,
            pictures=self.settings.pictures,
            seed=self.settings.seed,
        ).judged()


def worst_family(found: Mapping[Part, Sequence[Found]], seed: int) -> dict[str, Row]:
    """Family, style or distribution -> gain of lit's network over lit, of all that were judged."""
    gains = [each for part in found.values() for each in part if isinstance(each, Gains)]
    return {name: row for each in gains for name, row in each.worst_over_lit(seed).items()}
