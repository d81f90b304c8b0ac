"""Benchmark `relighting`: the neural renderer against baselines on held-out scenes and lights."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field, NonNegativeInt, PositiveInt

from eval.benchmark import Benchmark
from eval.relighting.baselines import fit_baselines
from eval.relighting.buffers import MEMBERS
from eval.relighting.gallery import Example, comparison, guidance, opening
from eval.relighting.guidance import GuidanceScores
from eval.relighting.judging import judge
from eval.relighting.networks import Network, find_weights, load_networks
from eval.relighting.scores import Scores
from eval.report.outcome import Outcome, training_curves
from tron.errors import TronError
from tron.neural.shipped import SHIPPED
from tron.runtime import set_torch_threads
from tron.shards.dataset_folder import DatasetFolder, DatasetPlace, Place
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips
from tron.shards.schema import Clip
from tron.storage import sha256

log = logging.getLogger("tron.eval")

Weights = Path | Annotated[tuple[Path, ...], Field(min_length=1)]


class Relighting(Benchmark):
    """Settings: the data set, the weights, and the number of clips on the page."""

    name: ClassVar[str] = "relighting"

    dataset: DatasetPlace | None = Field(description="folder written by tron-datagen, or its URL")
    renderer: Weights | None = Field(
        default=None,
        description="weights of the neural renderer, .safetensors, or the name of a shipped checkpoint "
        f"({', '.join(SHIPPED)}); of two, [a,b], one sees lit, one does not",
    )
    pixel_mlp: Weights | None = Field(
        default=None, description="weights of the pixel MLP baseline; [a,b] as for renderer"
    )
    ood: DatasetPlace | None = Field(
        default=None,
        description="data set of another kind (tron-datagen experiment=models): its test split gives rows "
        "that end in .ood, by the same weights and fits",
    )
    vae: Path | None = Field(default=None, description="file of the WAN 2.1 VAE, if the codec needs it")
    train_splits: list[str] = Field(
        default=["train"], description="splits for fitting baselines", min_length=1
    )
    fitted_on: DatasetPlace | None = Field(
        default=None,
        description="data set whose training splits they see; null: dataset, which has none where it is a "
        "benchmark such as TRON-Synth",
    )
    test_split: str = "test"
    pictures: NonNegativeInt = Field(default=6, description="number of held-out clips on the page")
    threads: PositiveInt = 1
    seed: int = 0

    def check(self) -> None:
        """Find the data sets, their splits and the weights; TronError names what is missing."""
        manifest = Manifest.load(self._dataset())
        manifest.of_split(self.test_split)
        fitted_on = Manifest.load(self._fitted_on())
        if self.fitted_on is None and set(manifest.splits()) == {self.test_split}:
            raise TronError(
                f"the data set has no split {self.train_splits[0]} to fit the baselines on",
                self._dataset(),
                "give benchmark.fitted_on=DIR, a data set that is trained on",
            )
        for split in self.train_splits:
            fitted_on.of_split(split)
        if self.ood is not None:
            Manifest.load(self.ood).of_split(self.test_split)
        for path in (path for paths in self._weights().values() for path in paths):
            find_weights(path)
        if self.vae is not None and not self.vae.exists():
            raise TronError("weights not found", self.vae, "give the WAN 2.1 VAE's file")

    def run(self, output_dir: Path) -> Outcome:
        """Fit on the training splits, score the test split, and make pictures of chosen clips."""
        self.check()
        dataset = self._dataset()
        set_torch_threads(self.threads)
        if self.renderer is None:
            log.warning("no renderer given: its rows will be absent")
        if self.pixel_mlp is None:
            log.warning(
                "no pixel_mlp given: its rows will be absent, and so will gains over the best baseline, "
                "which it may be; tron-train renderer=pixel_mlp makes one"
            )
        networks = self._networks()
        log.info("fitting the baselines on %s", ", ".join(self.train_splits))
        fitted = fit_baselines(self._training_clips(), self.seed)
        methods = {name: each.show for name, each in fitted.items()}
        methods |= {name: network.show for name, network in networks.items()}
        surfels, outcome = GuidanceScores(), Outcome(output_dir)
        judged = judge(dataset, self.test_split, lambda _: methods, self.pictures, Scores(), look=surfels.add)
        outcome.rows += [*judged.scores.rows(self.seed), *surfels.rows(self.seed)]
        _show(outcome, judged.examples)
        if self.ood is not None:
            ood = judge(self.ood, self.test_split, lambda _: methods, self.pictures, Scores(tail=".ood"))
            outcome.rows += ood.scores.rows(self.seed)
            for each in ood.examples:
                outcome.show("ood", f"ood-{each.meta.key}", comparison(each))
        manifest = Manifest.load(dataset)
        outcome.inputs |= {
            "stand_ins": stand_ins(dataset),
            "dataset_config_sha256": manifest.config_sha256,
            "clips": {entry: sum(s.samples for s in manifest.of_split(entry)) for entry in manifest.splits()},
            "fitted_weights": {name: each.weights.round(4).tolist() for name, each in fitted.items()},
            **{f"{name}_sha256": sha256(network.path) for name, network in networks.items()},
        }
        for name, folder in (("ood", self.ood), ("fitted_on", self.fitted_on)):
            if folder is not None:
                outcome.inputs[f"{name}_config_sha256"] = Manifest.load(folder).config_sha256
        outcome.series |= training_curves(
            {name: network.path.parent / "metrics.csv" for name, network in networks.items()}
        )
        return outcome

    def _dataset(self) -> Place:
        if self.dataset is None:
            raise TronError("no data set to evaluate on", mend="give dataset=DIR, made by tron-datagen")
        return self.dataset

    def _fitted_on(self) -> Place:
        return self._dataset() if self.fitted_on is None else self.fitted_on

    def _training_clips(self) -> Iterator[Clip]:
        for split in self.train_splits:
            yield from read_clips(self._fitted_on(), split, MEMBERS)

    def _weights(self) -> dict[str, list[Path]]:
        """Return kind of network -> files or names of all given weights."""
        given = {"neural": self.renderer, "pixel_mlp": self.pixel_mlp}
        return {
            kind: [paths] if isinstance(paths, Path) else [*(paths or ())] for kind, paths in given.items()
        }

    def _networks(self) -> dict[str, Network]:
        """Return method -> network; TronError if two networks are the same method."""
        return {
            name: network
            for kind, paths in self._weights().items()
            for name, network in load_networks(kind, paths, self.vae).items()
        }


def _show(outcome: Outcome, examples: list[Example]) -> None:
    """Show the middle example on the first screen, then all, and the guidance of one per light family."""
    if examples:
        outcome.show("opening", "opening", opening(examples[len(examples) // 2]))
    for each in examples:
        outcome.show("pictures", each.meta.key, comparison(each))
    drawn = {each.meta.light_family: each for each in reversed(examples) if each.guidance}
    for each in drawn.values():
        outcome.show("guidance", f"{each.meta.key}-guidance", guidance(each))


def stand_ins(dataset: Place) -> str:
    """Return a sentence on the assets that the data set replaced by others, from its sources.json."""
    folder, name = DatasetFolder(dataset), "sources.json"
    try:
        found = json.loads(folder.read(name))["stand_ins"] if folder.size(name) is not None else None
        if found is None:
            return ""
        named = found["maps"] + found["models"]
        empty = len(found["empty_maps"]) + found["empty_models"]
        return f"{found['title']}: {empty} of {named} named assets are procedural stand-ins."
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TronError(
            "sources.json is damaged", folder.where(name), "run tron-datagen on the data set again"
        ) from error
