"""Benchmark `relighting`: the neural renderer against seven baselines on held-out scenes and lights."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveInt

from eval.benchmark import Benchmark
from eval.relighting import page
from eval.relighting.gallery import Shown, middle_frame
from eval.relighting.guidance import GuidanceScores
from eval.relighting.predictions import MEMBERS, Predictor, Render, displayed_truth, fit_baselines
from eval.relighting.scores import Scores
from eval.report.charts import training_curves
from eval.report.outcome import Outcome
from eval.report.page import Chart
from tron.errors import TronError
from tron.runtime import set_torch_threads
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips
from tron.shards.schema import Clip
from tron.storage import sha256

log = logging.getLogger("tron.eval")


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
        manifest = Manifest.load(dataset)
        set_torch_threads(self.threads)
        networks = self._networks()
        log.info("fitting the baselines on %s", ", ".join(self.train_splits))
        predictor = Predictor(fit_baselines(self._training_clips(), self.seed), networks)
        scores, guidance, clips = Scores(), GuidanceScores(), []
        for clip in read_clips(dataset, self.test_split):
            scores.add(clip, predictor.shown(clip), displayed_truth(clip))
            guidance.add(clip)
            clips.append(clip.meta)
            log.info("scored clip %s (%s, %s)", clip.meta.key, clip.meta.light, clip.meta.light_family)
        shown = self._shown(predictor, choose_clips(scores, self.pictures))
        inputs: dict[str, Any] = {
            "dataset_config_sha256": manifest.config_sha256,
            "clips": {entry: sum(s.samples for s in manifest.of_split(entry)) for entry in manifest.splits()},
            "fitted_scale": predictor.fits.scale,
        }
        for name, path in (("renderer", self.renderer), ("pixel_mlp", self.pixel_mlp)):
            if path is not None:
                inputs[f"{name}_sha256"] = sha256(path)
        return page.outcome(
            scores,
            guidance,
            clips,
            shown,
            self._curves(),
            inputs,
            output_dir,
            self._typed(output_dir),
            self.seed,
        )

    def _dataset(self) -> Path:
        if self.dataset is None:
            raise TronError("no data set to evaluate on", mend="give dataset=DIR, made by tron-datagen")
        return self.dataset

    def _training_clips(self) -> Iterator[Clip]:
        for split in self.train_splits:
            yield from read_clips(self._dataset(), split, MEMBERS)

    def _networks(self) -> dict[str, Render]:
        given = {"neural": self.renderer, "pixel_mlp": self.pixel_mlp}
        for name, path in given.items():
            if path is None:
                log.warning("no weights for %s: its rows will be absent", name)
        return {name: load_network(path, self.vae) for name, path in given.items() if path is not None}

    def _curves(self) -> list[Chart]:
        """Curves of the trainings whose metrics.csv lies beside the weights."""
        given = {"neural": self.renderer, "pixel_mlp": self.pixel_mlp}
        return training_curves({name: path.parent / "metrics.csv" for name, path in given.items() if path})

    def _typed(self, output_dir: Path) -> list[str]:
        inputs = {"dataset": self.dataset, "renderer": self.renderer, "pixel_mlp": self.pixel_mlp}
        given = [f"{name}={path}" for name, path in inputs.items() if path is not None]
        return [" \\\n    ".join(["tron-eval benchmark=relighting", *given, f"output_dir={output_dir}"])]

    def _shown(self, predictor: Predictor, keys: list[str]) -> list[Shown]:
        """The middle frames of the chosen clips by every method, in that order: a second pass."""
        if not keys:
            return []
        shown = {
            clip.meta.key: middle_frame(clip, predictor.shown(clip)["frame"], displayed_truth(clip))
            for clip in read_clips(self._dataset(), self.test_split)
            if clip.meta.key in keys
        }
        return [shown[key] for key in keys]


def load_network(path: Path, vae: Path | None = None) -> Render:
    """Weights on disk -> a function that shows clips; torch is imported here and not before.

    Raises:
        TronError: the file is missing or holds no renderer.
    """
    from tron.neural.renderer import render_clip
    from tron.neural.weights import load_renderer

    renderer = load_renderer(path, vae)
    return lambda pbr, irradiance, exposure: render_clip(renderer, pbr, irradiance, exposure)


def choose_clips(scores: Scores, count: int) -> list[str]:
    """Clips to show: evenly spaced in the ranking by gain, so that the worst and the best are among them.

    The gain is neural PSNR minus that of the best of the baselines that were scored, foreground; without a
    neural renderer the clips are ranked by the PSNR of pbr.
    """
    keys = list(dict.fromkeys(score.clip for score in scores.entries))
    baselines = [method for method in scores.methods if method != "neural"]

    def rank(key: str) -> float:
        gain = scores.gain(baselines, "foreground", clip=key)
        alone = scores.mean("pbr", "foreground", clip=key)
        return gain[0] if gain else alone[0] if alone else -np.inf

    ordered = sorted(keys, key=rank)
    if len(ordered) <= count:
        return ordered
    places = (
        np.linspace(0, len(ordered) - 1, count).round().astype(int) if count > 1 else np.zeros(count, int)
    )
    return [ordered[place] for place in dict.fromkeys(places.tolist())]
