"""Benchmark `relighting`: the neural renderer against baselines on held-out scenes and lights."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveInt

from eval.benchmark import Benchmark
from eval.relighting import page
from eval.relighting.baselines import NEURAL, fit_baselines, predictions
from eval.relighting.buffers import MEMBERS
from eval.relighting.fits import Show
from eval.relighting.gallery import Example, middle_frame
from eval.relighting.guidance import GuidanceScores
from eval.relighting.measured import Measured
from eval.relighting.scores import Scores, Where
from eval.report.charts import training_curves
from eval.report.outcome import Outcome
from tron.errors import TronError
from tron.runtime import set_torch_threads
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips
from tron.shards.schema import Clip
from tron.storage import sha256

log = logging.getLogger("tron.eval")

SETTINGS = {"neural": "renderer", "pixel_mlp": "pixel_mlp"}
"""Network -> the setting that names its weights."""


class Relighting(Benchmark):
    """Settings: the data set, the weights, and how much of them is shown."""

    name: ClassVar[str] = "relighting"

    dataset: Path | None = Field(description="folder that tron-datagen wrote")
    renderer: Path | None = Field(default=None, description="weights of the neural renderer, .safetensors")
    pixel_mlp: Path | None = Field(default=None, description="weights of the pixel MLP baseline")
    vae: Path | None = Field(default=None, description="the WAN 2.1 VAE, where the renderer's codec needs it")
    train_splits: list[str] = Field(
        default=["train"], description="splits that the fitted baselines see", min_length=1
    )
    test_split: str = "test"
    pictures: NonNegativeInt = Field(default=6, description="held-out clips shown side by side")
    threads: PositiveInt = 1
    seed: int = 0

    def check(self) -> None:
        """Find the data set, its splits and the weights; TronError names what is missing."""
        manifest = Manifest.load(self._dataset())
        for split in (self.test_split, *self.train_splits):
            manifest.of_split(split)
        for path in (self.renderer, self.pixel_mlp, self.vae):
            if path is not None and not path.exists():
                raise TronError("weights not found", path, "give what tron-train wrote")

    def run(self, output_dir: Path) -> Outcome:
        """Fit on the training splits, score the test split, choose and make the pictures."""
        self.check()
        dataset = self._dataset()
        set_torch_threads(self.threads)
        for name in SETTINGS.keys() - self._weights():
            log.warning("no weights for %s: its rows will be absent", name)
        networks = {name: load_network(path, self.vae) for name, path in self._weights().items()}
        log.info("fitting the baselines on %s", ", ".join(self.train_splits))
        fitted = fit_baselines(self._training_clips(), self.seed)
        methods = {name: each.show for name, each in fitted.items()} | networks
        scores, guidance, clips = Scores(), GuidanceScores(), []
        for clip in read_clips(dataset, self.test_split):
            scores.add(clip, predictions(clip, methods), clip.displayed("rgb"))
            guidance.add(clip)
            clips.append(clip.meta)
            log.info("scored clip %s (%s, %s)", clip.meta.key, clip.meta.light, clip.meta.light_family)
        rows = [*scores.rows(self.seed), *guidance.rows(self.seed)]
        measured = Measured(
            scores=scores,
            guidance=guidance,
            rows={row.metric: row for row in rows},
            clips=clips,
            examples=self._examples(methods, choose_clips(scores, self.pictures)),
            curves=training_curves(
                {name: path.parent / "metrics.csv" for name, path in self._weights().items()}
            ),
        )
        manifest = Manifest.load(dataset)
        inputs = {
            "dataset_config_sha256": manifest.config_sha256,
            "clips": {entry: sum(s.samples for s in manifest.of_split(entry)) for entry in manifest.splits()},
            "fitted_weights": {name: each.weights.round(4).tolist() for name, each in fitted.items()},
            **{f"{SETTINGS[name]}_sha256": sha256(path) for name, path in self._weights().items()},
        }
        return Outcome(
            rows=rows,
            title="Relighting held-out scenes under held-out lights",
            verdict=page.verdict(measured),
            lead=page.LEAD,
            sections=page.sections(measured, output_dir / "pictures"),
            headline=page.HEADLINE,
            reproduce=[self._typed(output_dir)],
            inputs=inputs,
        )

    def _dataset(self) -> Path:
        if self.dataset is None:
            raise TronError("no data set to evaluate on", mend="give dataset=DIR, made by tron-datagen")
        return self.dataset

    def _training_clips(self) -> Iterator[Clip]:
        for split in self.train_splits:
            yield from read_clips(self._dataset(), split, MEMBERS)

    def _weights(self) -> dict[str, Path]:
        """Network -> the file of its weights, of those that were given."""
        return {name: path for name, key in SETTINGS.items() if (path := getattr(self, key)) is not None}

    def _typed(self, output_dir: Path) -> str:
        inputs = {"dataset": self.dataset, "renderer": self.renderer, "pixel_mlp": self.pixel_mlp}
        given = [f"{name}={path}" for name, path in inputs.items() if path is not None]
        return " \\\n    ".join(["tron-eval benchmark=relighting", *given, f"output_dir={output_dir}"])

    def _examples(self, methods: Mapping[str, Show], keys: list[str]) -> list[Example]:
        """The middle frames of the chosen clips by every method, in that order: a second pass."""
        if not keys:
            return []
        examples = {
            clip.meta.key: middle_frame(clip, predictions(clip, methods)["frame"], clip.displayed("rgb"))
            for clip in read_clips(self._dataset(), self.test_split)
            if clip.meta.key in keys
        }
        return [examples[key] for key in keys]


def load_network(path: Path, vae: Path | None = None) -> Show:
    """Weights on disk -> a method; torch is imported here and not before.

    Raises:
        TronError: the file is missing or holds no renderer.
    """
    from tron.neural.renderer import render_clip
    from tron.neural.weights import load_renderer

    renderer = load_renderer(path, vae)
    guidance = renderer.config.guidance
    return lambda buffers: render_clip(renderer, {name: buffers.displayed(name) for name in guidance})


def choose_clips(scores: Scores, count: int) -> list[str]:
    """Clips to show: evenly spaced in the ranking by gain, so that the worst and the best are among them.

    The gain is neural PSNR minus that of the best of the baselines that were scored, foreground; without a
    neural renderer the clips are ranked by the PSNR of pbr.
    """
    baselines = [method.name for method in scores.methods if method is not NEURAL]

    def rank(key: str) -> float:
        of_clip = Where(clip=key)
        found = (scores.gain(baselines, of_clip), scores.psnr("pbr", of_clip))
        return next((figure for figure in found if figure is not None), -np.inf)

    ordered = sorted(scores.clips, key=rank)
    places = np.linspace(0, len(ordered) - 1, min(count, len(ordered))).round().astype(int)
    return [ordered[place] for place in places]
