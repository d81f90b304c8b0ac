"""Benchmark `relighting`: the neural renderer against baselines on held-out scenes and lights."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveInt

from eval.benchmark import Benchmark
from eval.relighting import page
from eval.relighting.baselines import BASELINES, fit_baselines, predictions
from eval.relighting.buffers import MEMBERS, Buffers
from eval.relighting.fits import Show
from eval.relighting.gallery import Example, middle_frame
from eval.relighting.guidance import GuidanceScores
from eval.relighting.measured import Judged, Measured
from eval.relighting.scores import Scores, Where
from eval.report.charts import training_curves
from eval.report.outcome import Outcome
from tron.dataset_folder import DatasetFolder, DatasetPlace, Place
from tron.errors import TronError
from tron.neural.shipped import SHIPPED, checkpoint_file
from tron.runtime import set_torch_threads
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips
from tron.shards.schema import Clip
from tron.storage import sha256

log = logging.getLogger("tron.eval")

Weights = Path | Annotated[tuple[Path, ...], Field(min_length=1)]


class Relighting(Benchmark):
    """Settings: the data set, the weights, and how much of them is shown."""

    name: ClassVar[str] = "relighting"

    dataset: DatasetPlace | None = Field(description="folder that tron-datagen wrote, or its URL")
    renderer: Weights | None = Field(
        default=None,
        description="weights of the neural renderer, .safetensors, or the name of a shipped checkpoint "
        f"({', '.join(SHIPPED)}); of two, [a,b], one sees lit, one does not",
    )
    pixel_mlp: Weights | None = Field(default=None, description="weights of the pixel MLP baseline, likewise")
    ood: DatasetPlace | None = Field(
        default=None,
        description="data set of another kind (tron-datagen experiment=models): its test split gives rows "
        "that end in .ood, by the same weights and fits",
    )
    vae: Path | None = Field(default=None, description="the WAN 2.1 VAE, where the renderer's codec needs it")
    train_splits: list[str] = Field(
        default=["train"], description="splits that the fitted baselines see", min_length=1
    )
    fitted_on: DatasetPlace | None = Field(
        default=None,
        description="data set whose training splits they see; null: dataset, which has none where it is a "
        "benchmark such as TRON-Synth",
    )
    test_split: str = "test"
    pictures: NonNegativeInt = Field(default=6, description="held-out clips shown side by side")
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
        for path in (*(path for _, path in self._weights()), self.vae):
            if path is not None and not path.exists():
                mend = f"give what tron-train wrote, or one of {', '.join(SHIPPED)}"
                raise TronError("weights not found", path, mend)

    def run(self, output_dir: Path) -> Outcome:
        """Fit on the training splits, score the test split, choose and make the pictures."""
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
        guidance = GuidanceScores()
        judged = self._judged(dataset, methods, Scores(), guidance)
        rows = [*judged.scores.rows(self.seed), *guidance.rows(self.seed)]
        ood = None if self.ood is None else self._judged(self.ood, methods, Scores(tail=".ood"))
        if ood is not None:
            rows += ood.scores.rows(self.seed)
        measured = Measured(
            judged=judged,
            ood=ood,
            guidance=guidance,
            rows={row.metric: row for row in rows},
            curves=training_curves(
                {name: network.path.parent / "metrics.csv" for name, network in networks.items()}
            ),
        )
        manifest = Manifest.load(dataset)
        inputs = {
            "dataset_config_sha256": manifest.config_sha256,
            "clips": {entry: sum(s.samples for s in manifest.of_split(entry)) for entry in manifest.splits()},
            "fitted_weights": {name: each.weights.round(4).tolist() for name, each in fitted.items()},
            **{f"{name}_sha256": sha256(network.path) for name, network in networks.items()},
        }
        for name, folder in (("ood", self.ood), ("fitted_on", self.fitted_on)):
            if folder is not None:
                inputs[f"{name}_config_sha256"] = Manifest.load(folder).config_sha256
        return Outcome(
            rows=rows,
            title="Relighting held-out scenes under held-out lights",
            verdict=page.verdict(measured),
            lead=(*page.LEAD, *stand_ins(dataset)),
            sections=page.sections(measured, output_dir / "pictures"),
            headline=page.HEADLINE,
            reproduce=[self._typed(output_dir)],
            inputs=inputs,
        )

    def _judged(
        self,
        dataset: Place,
        methods: Mapping[str, Show],
        scores: Scores,
        guidance: GuidanceScores | None = None,
    ) -> Judged:
        """Every method on the test split of a data set, and pictures of some clips of it."""
        clips = []
        for clip in read_clips(dataset, self.test_split):
            scores.add(clip, predictions(clip, methods), clip.displayed("rgb"))
            if guidance is not None:
                guidance.add(clip)
            clips.append(clip.meta)
            log.info("scored clip %s (%s, %s)", clip.meta.key, clip.meta.light, clip.meta.light_family)
        examples = self._examples(dataset, methods, choose_clips(scores, self.pictures))
        return Judged(scores, clips, examples)

    def _dataset(self) -> Place:
        if self.dataset is None:
            raise TronError("no data set to evaluate on", mend="give dataset=DIR, made by tron-datagen")
        return self.dataset

    def _fitted_on(self) -> Place:
        return self._dataset() if self.fitted_on is None else self.fitted_on

    def _training_clips(self) -> Iterator[Clip]:
        for split in self.train_splits:
            yield from read_clips(self._fitted_on(), split, MEMBERS)

    def _weights(self) -> Iterator[tuple[str, Path]]:
        """Kind of network and file of all weights that were given."""
        for kind, given in (("neural", self.renderer), ("pixel_mlp", self.pixel_mlp)):
            for path in [given] if isinstance(given, Path) else given or ():
                yield kind, checkpoint_file(path)

    def _networks(self) -> dict[str, Network]:
        """Method -> the network; TronError where two are the same method."""
        networks: dict[str, Network] = {}
        for kind, path in self._weights():
            network = load_network(path, self.vae)
            name = f"{kind}_lit" if network.sees_lit else kind
            if name in networks:
                raise TronError(
                    f"two weights of {name}, the other is {networks[name].path}", path, "give one of them"
                )
            networks[name] = network
        return networks

    def _typed(self, output_dir: Path) -> str:
        inputs = {name: getattr(self, name) for name in ("dataset", "renderer", "pixel_mlp")}
        given = [f"{name}={_typed_value(value)}" for name, value in inputs.items() if value is not None]
        for name in ("fitted_on", "ood"):
            if getattr(self, name) is not None:
                given.append(f"benchmark.{name}={getattr(self, name)}")
        return " \\\n    ".join(["tron-eval benchmark=relighting", *given, f"output_dir={output_dir}"])

    def _examples(self, dataset: Place, methods: Mapping[str, Show], keys: list[str]) -> list[Example]:
        """The middle frames of the chosen clips by every method, in that order: a second pass."""
        if not keys:
            return []
        examples = {
            clip.meta.key: middle_frame(clip, predictions(clip, methods)["frame"], clip.displayed("rgb"))
            for clip in read_clips(dataset, self.test_split)
            if clip.meta.key in keys
        }
        return [examples[key] for key in keys]


def _typed_value(value: Any) -> str:
    return f"[{','.join(map(str, value))}]" if isinstance(value, tuple) else str(value)


class Network(NamedTuple):
    """A network as a method, the file of its weights, and whether lit is among its guidance."""

    show: Show
    path: Path
    sees_lit: bool


def load_network(path: Path, vae: Path | None = None) -> Network:
    """Weights on disk -> the network; torch is imported here and not before.

    Raises:
        TronError: the file is missing or holds no renderer.
    """
    from tron.neural.renderer import render_clip
    from tron.neural.weights import load_renderer

    renderer = load_renderer(path, vae)
    guidance = renderer.config.guidance

    def show(buffers: Buffers) -> np.ndarray:
        shown = {each: buffers.displayed(each) for each in guidance}
        return render_clip(renderer, shown, motion=buffers.motion)

    return Network(show, path, "lit" in guidance)


def stand_ins(dataset: Place) -> Sequence[str]:
    """Sentence of the data set's sources.json on named assets that something else stands in for."""
    folder, name = DatasetFolder(dataset), "sources.json"
    try:
        found = json.loads(folder.read(name))["stand_ins"] if folder.size(name) is not None else None
        if found is None:
            return ()
        named = found["maps"] + found["models"]
        empty = len(found["empty_maps"]) + found["empty_models"]
        return (f"{found['title']}: {empty} of {named} named assets are procedural stand-ins.",)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TronError(
            "sources.json is damaged", folder.where(name), "run tron-datagen on the data set again"
        ) from error


def choose_clips(scores: Scores, count: int) -> list[str]:
    """Clips to show: evenly spaced in the ranking by gain, so that the worst and the best are among them.

    The gain is the network's PSNR minus that of the best of the baselines that were scored, foreground;
    without a network the clips are ranked by the PSNR of lit.
    """
    baselines = [method.name for method in scores.methods if method in BASELINES]

    def rank(key: str) -> float:
        of_clip, network = Where(clip=key), scores.network
        gain = None if network is None else scores.gain(network.name, baselines, of_clip)
        found = (gain, scores.psnr("lit", of_clip), scores.psnr("pbr", of_clip))
        return next((figure for figure in found if figure is not None), -np.inf)

    ordered = sorted(scores.clips, key=rank)
    places = np.linspace(0, len(ordered) - 1, min(count, len(ordered))).round().astype(int)
    return [ordered[place] for place in places]
