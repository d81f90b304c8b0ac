"""Gain of a wider world: a renderer trained on the old distribution and one on the new, both judged.

Both datasets have as many lights and frames of the same size, and both renderers train for as long, side by
side on a thread each. They are judged by real models under photographed light, which neither has seen, and on
test scenes of the old distribution, which the first was trained for. Real models stand on floors and among
things of one distribution or the other, so that their own pixels alone count.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from eval.datagen.model_pixels import DEPTH, ModelPixels
from eval.datagen.settings import VarietySettings
from eval.real_models import has_models, model_arguments, model_names, typed_list
from eval.relighting.benchmark import load_network
from eval.relighting.buffers import MEMBERS, Buffers, region_mask
from eval.relighting.fits import Show
from eval.report.figures import row_cell
from eval.report.intervals import interval_note
from eval.report.strips import write_strips
from eval.results import Row, mean_row
from eval.stages import ONE_THREAD, Child, StageFailed, Stages
from tron import metrics
from tron.report.page import Block, Picture, Pictures, Section, Table, Text
from tron.runtime import set_torch_threads
from tron.shards.reader import read_clips
from tron.shards.schema import Clip

log = logging.getLogger("tron.eval")

OLD, NEW, LIT = "old", "new", "lit"
HOME, ALONE, MIXED = "home", "alone", "mixed"
OOD = (ALONE, MIXED)
MODELS, FOREGROUND = "models", "foreground"
FEWEST_PIXELS = 20
"""Pixels of models below which a frame has no PSNR of them."""
JUDGES = {
    ALONE: "one real model",
    MIXED: "real models among procedural things",
    HOME: "test scenes of the old distribution",
}
REGIONS = {MODELS: "pixels of the models", FOREGROUND: "foreground"}
PLACES = ((ALONE, MODELS), (MIXED, MODELS), (ALONE, FOREGROUND), (MIXED, FOREGROUND), (HOME, FOREGROUND))
"""What is judged: scenes, and which of their pixels."""
Trained = tuple[str, str, int]
"""Distribution, renderer and seed of a training."""
SIDE_BY_SIDE = 2
"""Commands of one thread that run at the same time."""


@dataclass(frozen=True)
class Score:
    """PSNR of one frame's pixels of a region, dB; ``renderer`` is empty for lit."""

    judge: str
    region: str
    scene: str
    method: str
    renderer: str
    seed: int
    psnr: float


@dataclass(frozen=True)
class Example:
    """A frame by lit and both renderers, display values (H, W, 3)."""

    scene: str
    light: str
    images: Mapping[str, np.ndarray]
    truth: np.ndarray
    psnr: Mapping[str, float]


@dataclass
class Variety:
    """Scores of the renderers and of lit, the picture without one.

    Attributes:
        renderers: names of the trained ones; figures without a renderer's name are of the first.
        scores: every frame's.
        examples: judge -> frames of some of its scenes, by the first renderer.
        scenes: training dataset -> its training scenes.
        left_out: judging dataset that could not be made -> the reason.
    """

    renderers: Sequence[str]
    scores: list[Score] = field(default_factory=list)
    examples: dict[str, list[Example]] = field(default_factory=lambda: defaultdict(list))
    scenes: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)

    def mean(self, method: str, judges: Sequence[str], region: str, renderer: str = "") -> dict[str, float]:
        """Scene -> mean PSNR of a method over frames and seeds of the training."""
        found: defaultdict[str, list[float]] = defaultdict(list)
        wanted = "" if method == LIT else renderer or self.renderers[0]
        for score in self.scores:
            if (score.method, score.region, score.renderer) == (
                method,
                region,
                wanted,
            ) and score.judge in judges:
                found[score.scene].append(score.psnr)
        return {scene: float(np.mean(values)) for scene, values in found.items()}

    def gain(
        self, judges: Sequence[str], region: str, renderer: str, seed: int, metric: str, sign: float = 1.0
    ) -> Row | None:
        """New minus old in dB, times ``sign``, paired over scenes; None where nothing was judged."""
        old, new = (self.mean(method, judges, region, renderer) for method in (OLD, NEW))
        if not old:
            return None
        return mean_row(metric, "dB", [(scene, sign * (new[scene] - old[scene])) for scene in old], seed)

    def rows(self, seed: int) -> Iterator[Row]:
        """Gain on real models, loss on the old test scenes, and PSNR of everything, of every renderer."""
        for renderer in self.renderers:
            name = "variety" if renderer == self.renderers[0] else f"variety.{renderer}"
            yield from filter(
                None,
                (
                    self.gain(OOD, MODELS, renderer, seed, f"{name}.ood_gain_db"),
                    *(
                        self.gain([judge], MODELS, renderer, seed, f"{name}.ood_gain_db.{judge}")
                        for judge in OOD
                    ),
                    self.gain(OOD, FOREGROUND, renderer, seed, f"{name}.ood_gain_db.foreground"),
                    self.gain([HOME], FOREGROUND, renderer, seed, f"{name}.loss_db", -1.0),
                ),
            )
            methods = (OLD, NEW, LIT) if renderer == self.renderers[0] else (OLD, NEW)
            for judge, region in PLACES:
                for method in methods:
                    if found := self.mean(method, [judge], region, renderer):
                        metric = f"{name}.psnr.{method}.{judge}.{region}"
                        yield mean_row(metric, "dB", list(found.items()), seed)

    def sections(self, pictures: Path) -> list[Section]:
        """The two worlds in a table for each renderer, and side by side."""
        rows = {row.metric: row for row in self.rows(0)}
        blocks: list[Block] = []
        for renderer in self.renderers:
            name = "variety" if renderer == self.renderers[0] else f"variety.{renderer}"
            table = [
                [
                    f"{JUDGES[judge]}, {REGIONS[region]}",
                    row_cell(rows.get(f"variety.psnr.{LIT}.{judge}.{region}")),
                    *(row_cell(rows.get(f"{name}.psnr.{method}.{judge}.{region}")) for method in (OLD, NEW)),
                    row_cell(self.gain([judge], region, renderer, 0, "variety.gain"), "strong"),
                ]
                for judge, region in PLACES
            ]
            caption = (
                f"Renderer of {renderer.replace('_', ' ')}: PSNR, means over scenes, trained on "
                f"{self.scenes.get(OLD, 0)} scenes of the old distribution and on {self.scenes.get(NEW, 0)} "
                "of the new, for as long; lit is the picture without a network."
            )
            headings = ["Judged on", "lit", "trained on the old", "trained on the new", "gain"]
            blocks.append(Table(caption, headings, table))
        blocks.append(Text(interval_note(len({score.scene for score in self.scores}))))
        if self.left_out:
            said = "; ".join(f"{name}: {why}" for name, why in self.left_out.items())
            blocks.append(Text(f"Left out, since the data engine refused them: {said}."))
        for judge, examples in self.examples.items():
            shown = [_comparison(judge, example) for example in examples]
            write_strips(shown, [f"variety_{judge}_{k}" for k in range(len(shown))], pictures)
            blocks += shown
        return [Section("variety", "What a wider world teaches", blocks)]


def measure_variety(settings: VarietySettings, seed: int, folder: Path) -> Variety:
    """Make both datasets, train on both, make what judges them, and score it.

    Stages that are finished are not run again.

    Args:
        settings: recipes and sizes. seed: of the first judge. folder: for all files.

    Raises:
        StageFailed: a command failed, other than one of a judge's.
    """
    stages, found = Stages(folder), Variety(list(settings.train))
    datasets = {name: folder / name for name in (OLD, NEW)}
    for name, recipe in ((OLD, settings.old), (NEW, settings.new)):
        child = Child(name, "tron-datagen", [*recipe, f"output_dir={datasets[name]}"])
        stages.run(f"datagen_{name}", [child])
        found.scenes[name] = len(list(datasets[name].glob("scenes/train*/record.json")))
    weights: dict[Trained, Path] = {}
    for training in settings.seeds:
        for renderer, recipe in settings.train.items():
            children = []
            for name, dataset in datasets.items():
                output = folder / f"train_{name}_{renderer}_{training}"
                weights[name, renderer, training] = output / "renderer.safetensors"
                arguments = [*recipe, f"dataset={dataset}", f"output_dir={output}", f"seed={training}"]
                arguments.append(f"max_seconds={settings.max_seconds:g}")
                children.append(Child(output.name, "tron-train", arguments, ONE_THREAD))
            stages.run(f"train_{renderer}_{training}", children)
    judges = [(HOME, datasets[OLD]), *_make_judges(settings, seed, stages, folder, found)]
    set_torch_threads(1)
    shows = {key: load_network(path).show for key, path in weights.items()}
    for judge, dataset in judges:
        models: dict[str, ModelPixels] = {}
        for clip in read_clips(dataset, "test", (*MEMBERS, DEPTH)):
            regions = {FOREGROUND: region_mask(clip, "foreground")}
            if judge in OOD:
                scene = clip.meta.scene
                if scene not in models:
                    models = {scene: ModelPixels(dataset / "scenes" / scene)}
                regions[MODELS] = models[scene].masks(clip)
            _score(found, judge, dataset.name, clip, regions, shows, settings.pictures)
    return found


def _make_judges(
    settings: VarietySettings, seed: int, stages: Stages, folder: Path, found: Variety
) -> list[tuple[str, Path]]:
    """Datasets of real models, (judge, folder): one of each model alone, and some of all of them mixed."""
    data = settings.real_data
    if data is None or not has_models(data):
        log.warning("no assets and hdri in %s: nothing is judged by real models", data)
        return []
    models = model_names(data)
    common = [*settings.judge, *model_arguments(data)]
    wanted = [
        (
            ALONE,
            f"{ALONE}_{model.replace('/', '_')}",
            [*settings.alone, f"asset_names={typed_list([model])}", f"seed={seed + number}"],
        )
        for number, model in enumerate(models)
    ]
    wanted += [
        (MIXED, f"{MIXED}_{name}", [*own, f"seed={seed + len(models) + k}"])
        for k, (name, own) in enumerate(settings.mixed.items())
    ]
    children = {
        name: Child(name, "tron-datagen", [*common, *own, "workers=1", f"output_dir={folder / name}"])
        for _, name, own in wanted
    }
    names = list(children)
    for first in range(0, len(names), SIDE_BY_SIDE):
        _make_together(stages, [children[name] for name in names[first : first + SIDE_BY_SIDE]], found)
    return [(judge, folder / name) for judge, name, _ in wanted if name not in found.left_out]


def _make_together(stages: Stages, children: Sequence[Child], found: Variety) -> None:
    """Make some datasets at once; if one fails each by itself, and what fails then is left out.

    Once they were begun one by one they go on so: together, the one that fails would end the others while
    they write over a dataset that is finished.
    """
    if not any(child.label in stages.records for child in children):
        with suppress(StageFailed):
            stages.run(" ".join(child.label for child in children), children)
            return
    for child in children:
        try:
            stages.run(child.label, [child])
        except StageFailed as failure:
            log.error("%s is left out: %s", child.label, failure)
            found.left_out[child.label] = str(failure).rpartition(f"{child.script}: ")[2]


def _score(
    found: Variety,
    judge: str,
    dataset: str,
    clip: Clip,
    regions: Mapping[str, np.ndarray],
    shows: Mapping[Trained, Show],
    pictures: int,
) -> None:
    """Score a clip by every renderer and by lit; the first clips of a judge give pictures as well."""
    buffers, truth = Buffers.of(clip), clip.displayed("rgb")
    scene = f"{dataset}/{clip.meta.scene}"
    shown = {(LIT, "", 0): buffers.displayed("lit"), **{key: show(buffers) for key, show in shows.items()}}
    first: dict[str, float] = {}
    region_shown = MODELS if MODELS in regions else FOREGROUND
    seed = next(iter(shows))[2]
    for (method, renderer, training), frames in shown.items():
        for region, masks in regions.items():
            for number, (image, target, mask) in enumerate(zip(frames, truth, masks)):
                if mask.sum() < FEWEST_PIXELS:
                    continue
                psnr = metrics.capped_psnr(image, target, mask)
                found.scores.append(Score(judge, region, scene, method, renderer, training, psnr))
                if (
                    number == 0
                    and region == region_shown
                    and (renderer, training)
                    in (
                        ("", 0),
                        (found.renderers[0], seed),
                    )
                ):
                    first[method] = psnr
    new_scene = scene not in {each.scene for each in found.examples[judge]}
    if len(found.examples[judge]) < pictures and new_scene and first:
        keys = {LIT: (LIT, "", 0), **{name: (name, found.renderers[0], seed) for name in (OLD, NEW)}}
        images = {name: shown[key][0] for name, key in keys.items()}
        found.examples[judge].append(Example(scene, clip.meta.light, images, truth[0], first))


def _comparison(judge: str, example: Example) -> Pictures:
    """Lit and both renderers beside the truth."""
    where = f"scene {example.scene} under light {example.light}"
    titles = {LIT: "lit", OLD: "trained on the old", NEW: "trained on the new"}
    pictures = [
        Picture(
            image,
            titles[name],
            f"{titles[name]}, {where}",
            f"{example.psnr[name]:.1f} dB",
            strong=name == NEW,
        )
        for name, image in example.images.items()
    ]
    pictures.append(Picture(example.truth, "path-traced truth", f"path-traced truth, {where}"))
    return Pictures(f"{JUDGES[judge].capitalize()}: {example.scene}", pictures)
