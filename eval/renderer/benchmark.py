"""Benchmark `renderer`: the shipped checkpoints against the best methods without them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from eval.relighting.baselines import BASELINES, DENOISED, NEURAL_LIT, fit_baselines
from eval.relighting.buffers import MEMBERS
from eval.relighting.fits import Show
from eval.relighting.judging import Judged, judge
from eval.relighting.networks import Network, load_networks
from eval.relighting.scores import Scores
from eval.renderer.clips import measure_clips
from eval.renderer.datasets import (
    FIT,
    FIT_RELIT,
    TEST,
    TEST_RELIT,
    Datasets,
    Quality,
    RendererSettings,
    require_data,
)
from eval.renderer.gains import between, everywhere, gain_rows, over_lit, time_rows
from eval.renderer.identity import Identity, least_identity
from eval.renderer.pictures import comparison
from eval.renderer.shadows import measure_shadows
from eval.renderer.sharpness import Gradients
from eval.renderer.truths import TRUTH, Truths
from eval.renderer.validation import validation_rows
from eval.report.outcome import Outcome
from eval.results import Row
from eval.stages import script_path
from tron.cli.installation import require_own_packages
from tron.denoising import DENOISERS
from tron.errors import TronError
from tron.runtime import set_torch_threads
from tron.seeds import generator
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips
from tron.storage import sha256

log = logging.getLogger("tron.eval")

KINDS = {"neural_lit": "lit", "neural": "pair"}
"""Method -> what its rows call it."""
FOLDS = 4
"""Groups of scenes, each judged by fits on the others: a quarter of the scenes is left out of a fit."""
PREFIX: dict[Quality, str] = {"preview": "ood_", "final": "final_"}
"""Quality of real models' frames -> beginning of its rows."""
FEW = "few_"
"""Before that, where the surfels are few."""


class Renderer(RendererSettings):
    """The benchmark; finished data sets and trainings are reused."""

    def check(self) -> None:
        """Find the commands and the data sets, and read the checkpoints."""
        require_own_packages("datagen", "train")
        for name in ("tron-datagen", "tron-train"):
            script_path(name)
        require_data(self)
        load_networks("neural", self.weights())
        for name, row in DENOISERS.items():
            if DENOISED[name] not in BASELINES:
                log.warning("no rows of %s: it wants %s", row.title, row.mend)

    def run(self, output_dir: Path) -> Outcome:
        """Measure part by part; write one line per figure to stderr.

        Raises:
            StageFailed: a command failed.
            TronError: data or weights are not what they should be.
        """
        self.check()
        set_torch_threads(self.threads)
        run = Run(self, output_dir.absolute())
        for part in self.parts:
            run.datasets.stages.restart(f"part {part}")  # a figure of this run, never of one before
            with run.datasets.stages.timed(f"part {part}", [["tron-eval", f"benchmark.parts=[{part}]"]]):
                getattr(run, part)()
        if run.gains:
            worst = min(run.gains, key=lambda row: row.value)
            run.outcome.add([worst.model_copy(update={"metric": "renderer.lit.worst_family_gain_db"})])
        run.outcome.add([*everywhere(run.outcome.rows), *least_identity(run.outcome.rows)])
        run.outcome.inputs |= {
            f"{KINDS[name]}_sha256": sha256(each.path) for name, each in run.networks.items()
        }
        return run.outcome


class Run:
    """One method for each part. Data sets are made when a part first needs them, and kept.

    A part without its data is left out, and the log says what is missing.
    """

    def __init__(self, settings: Renderer, folder: Path):
        self.settings, self.outcome = settings, Outcome(folder)
        self.datasets = Datasets(settings, folder)
        self.gains: list[Row] = []
        """Of lit's network over lit, of all families, styles and distributions."""

    @cached_property
    def networks(self) -> dict[str, Network]:
        """The checkpoints, by method name."""
        return load_networks("neural", self.settings.weights())

    def synthetic(self) -> None:
        """Measure gains on held-out scenes and lights."""
        sizes = {size: self.datasets.synthetic(size) for size in self.settings.synthetic}
        self._judge("synthetic", "", sizes, TEST, FIT)

    def models(self) -> None:
        """Measure gains on real models at every size and quality; largest frames also with few surfels."""
        largest, scores = max(self.settings.models), dict[bool, Scores]()
        for size in self.settings.models:
            made: dict[tuple[bool, Quality], Path] = {
                (few, quality): dataset
                for few in (False, True)
                for quality in self.settings.qualities
                if not few or (size == largest and self.settings.few_surfels is not None)
                if (dataset := self.datasets.models(size, quality, few))
            }
            truths = Truths.of(made.values(), TEST)
            for (few, quality), dataset in made.items():
                judged = self._models_of(size, quality, few, dataset, truths)
                if size == largest and quality == "preview":
                    scores[few] = judged.scores
        if len(scores) == 2:
            name = f"renderer.preview_gain_db.{largest}"
            row = between(name, NEURAL_LIT.name, scores[False], scores[True], self.settings.seed)
            self.outcome.add([row] if row else [])

    def _models_of(self, size: int, quality: Quality, few: bool, dataset: Path, truths: Truths) -> Judged:
        """Add rows of one size, quality and number of surfels; show largest frames with default surfels."""
        first = size == min(self.settings.models) and quality == "preview"
        network = self.networks.get(NEURAL_LIT.name)
        identity = None if network is None else Identity(network, truths.linear)
        judged = self._judged(dataset, TEST, FIT, truths, first, identity)
        prefix = (FEW if few else "") + PREFIX[quality]
        if identity is not None:
            self.outcome.add(identity.rows(f"renderer.{prefix}", f".{size}", self.settings.seed))
        self._add(prefix, {size: judged}, every_size=True)
        clips = read_clips(dataset, TEST, ("foreground",))
        self.outcome.add(truths.rows(clips, f"renderer.{prefix}psnr.{TRUTH}", f".{size}", self.settings.seed))
        if first:
            self.gains += over_lit(judged.scores, self.settings.seed)
        if size == max(self.settings.models) and not few:
            self._show(f"models-{quality}", size, judged, "models")
        return judged

    def captures(self) -> None:
        """Measure gains on captures, reconstructed and relit."""
        dataset = self.datasets.captures()
        width = next(iter(read_clips(dataset, TEST_RELIT, ()))).meta.width
        self._judge("captures", "capture_", {width: dataset}, TEST_RELIT, FIT_RELIT)

    def clips(self) -> None:
        """Measure the flicker of averages along the motion over the flicker of single frames."""
        dataset = self.datasets.synthetic(next(iter(self.settings.synthetic)))
        measure_clips(dataset, TEST, self._by_kind(), self.settings.seed, self.outcome)

    def shadows(self) -> None:
        """Compare moving shadows with the true ones."""
        dataset = self.datasets.shadows()
        measure_shadows(dataset, TEST, self._by_kind(), self.settings.seed, self.outcome)

    def validation(self) -> None:
        """Measure the gains for checkpoint=auto, of the network that starts from lit and of its rival."""
        if network := self.networks.get(NEURAL_LIT.name):
            for size in self.settings.validation:
                dataset = self.datasets.validation(size)
                self.outcome.add(validation_rows(dataset, TEST, network, size, self.settings.seed))

    def _by_kind(self) -> dict[str, Network]:
        return {kind: self.networks[name] for name, kind in KINDS.items() if name in self.networks}

    def _judge(self, name: str, prefix: str, sizes: Mapping[int, Path], split: str, fit_split: str) -> None:
        """Measure gains on one distribution; figures without a size use the first, pictures the largest."""
        judged = {size: self._judged(dataset, split, fit_split) for size, dataset in sizes.items()}
        self._add(prefix, judged)
        self.gains += over_lit(next(iter(judged.values())).scores, self.settings.seed)
        self._show(name, max(judged), judged[max(judged)], name)

    def _add(self, prefix: str, judged: Mapping[int, Judged], every_size: bool = False) -> None:
        """Add rows of one distribution; ``every_size`` as in `gain_rows`."""
        scores = {size: each.scores for size, each in judged.items()}
        self.outcome.add(gain_rows(prefix, scores, self.settings.seed, every_size))
        for size, each in judged.items():
            self.outcome.add(time_rows(prefix, each.seconds, size))

    def _show(self, name: str, size: int, judged: Judged, section: str) -> None:
        for example in judged.examples:
            self.outcome.show(section, f"renderer-{name}-{size}-{example.meta.key}", comparison(example))

    def _judged(
        self,
        dataset: Path,
        split: str,
        fit_split: str,
        truths: Truths | None = None,
        per_pixel: bool = True,
        identity: Identity | None = None,
    ) -> Judged:
        """Judge all methods on a data set, materials too; ``per_pixel``: train per-pixel networks on it.

        The truth is the mean of all renders, which also give sharpness; identity is measured on the same
        clips.
        """
        paths = self.datasets.pixel_mlps(dataset, fit_split) if per_pixel else []
        trained = [load_networks("pixel_mlp", [path]) for path in paths]
        shown = {name: net.show for nets in (*trained, self.networks) for name, net in nets.items()}
        fits = fitted(dataset, split, fit_split, self.settings.seed)
        known: dict[str, Any] = {} if truths is None else {"truth": truths.displayed}
        if identity is not None:
            known["look"] = identity.add
        return judge(
            dataset,
            split,
            lambda scene: {**fits[scene], **shown},
            self.settings.pictures,
            Scores(materials=True, more=None if truths is None else Gradients(truths)),
            MEMBERS,
            **known,
        )


def fitted(dataset: Path, split: str, fit_split: str, seed: int) -> dict[str, dict[str, Show]]:
    """Return scene of a split -> baseline -> fitted method; fits use the distribution of the test.

    If the data set has a training split, fits use it. Otherwise the scenes are divided into groups, and each
    group is judged by fits on the other groups, so that no baseline was fitted on the scene of its test.

    Raises:
        TronError: the data set lacks the split, or has neither a training split nor two scenes.
    """
    manifest = Manifest.load(dataset)
    manifest.of_split(split)
    scenes = sorted({clip.meta.scene for clip in read_clips(dataset, split, ())})
    groups = [scenes] if fit_split in manifest.splits() else fold(scenes, FOLDS, seed)
    if fit_split not in manifest.splits() and len(scenes) < 2:
        raise TronError(
            f"no split '{fit_split}' and one scene: nothing is left to fit baselines on",
            dataset,
            "make two scenes or more",
        )
    found: dict[str, dict[str, Show]] = {}
    for group in groups:
        if fit_split in manifest.splits():
            clips = read_clips(dataset, fit_split, MEMBERS)
        else:
            clips = (clip for clip in read_clips(dataset, split, MEMBERS) if clip.meta.scene not in group)
        methods = {name: each.show for name, each in fit_baselines(clips, seed).items()}
        found |= dict.fromkeys(group, methods)
    return found


def fold(scenes: list[str], folds: int, seed: int) -> list[list[str]]:
    """Divide scenes into random groups of nearly equal size; there are at most as many groups as scenes."""
    order = generator(seed, "eval", "folds").permutation(len(scenes))
    count = min(folds, len(scenes))
    return [[scenes[k] for k in np.sort(order[start::count])] for start in range(count)]
