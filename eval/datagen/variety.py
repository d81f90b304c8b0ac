"""Gain of a wider world: a renderer trained on the old distribution and one on the new, both judged.

Both datasets have as many scenes, lights and frames of the same size, and both renderers train for as long,
side by side on a thread each. They are judged by real models under photographed light, which neither has
seen, and on test scenes of the old distribution, which the first was trained for.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from eval.datagen.settings import VarietySettings
from eval.relighting.benchmark import load_network
from eval.relighting.buffers import MEMBERS, Buffers, region_mask
from eval.relighting.fits import Show
from eval.report.figures import row_cell
from eval.report.intervals import interval_note
from eval.report.strips import write_strips
from eval.results import Row, mean_row
from eval.stages import Child, StageFailed, Stages
from tron import metrics
from tron.report.page import Block, Picture, Pictures, Section, Table, Text
from tron.runtime import set_torch_threads
from tron.shards.reader import read_clips
from tron.shards.schema import Clip

log = logging.getLogger("tron.eval")

OLD, NEW, LIT = "old", "new", "lit"
HOME, ALONE, MIXED = "home", "alone", "mixed"
OOD = (ALONE, MIXED)
JUDGES = {
    ALONE: "one real model",
    MIXED: "real models among procedural things",
    HOME: "test scenes of the old distribution",
}
MODELS = (".gltf", ".glb", ".obj")
MAPS = (".hdr", ".exr")
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
SIDE_BY_SIDE = 2
"""Commands of one thread that run at the same time."""


@dataclass(frozen=True)
class Score:
    """Foreground PSNR of one frame, dB."""

    judge: str
    scene: str
    method: str
    seed: int
    psnr: float


@dataclass(frozen=True)
class Example:
    """A frame by lit and both renderers, display values (H, W, 3); ``mask`` (H, W) is its foreground."""

    scene: str
    light: str
    images: Mapping[str, np.ndarray]
    truth: np.ndarray
    mask: np.ndarray


@dataclass
class Variety:
    """Scores of the renderers and of lit, the picture without one.

    Attributes:
        scores: every frame's.
        examples: judge -> frames of some of its scenes.
        scenes: training dataset -> its training scenes.
        left_out: judging dataset that could not be made -> the reason.
    """

    scores: list[Score] = field(default_factory=list)
    examples: dict[str, list[Example]] = field(default_factory=lambda: defaultdict(list))
    scenes: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)

    def mean(self, method: str, judges: Sequence[str]) -> dict[str, float]:
        """Scene -> mean PSNR of a method over frames and seeds of the training."""
        found: defaultdict[str, list[float]] = defaultdict(list)
        for score in self.scores:
            if score.method == method and score.judge in judges:
                found[score.scene].append(score.psnr)
        return {scene: float(np.mean(values)) for scene, values in found.items()}

    def gain(self, judges: Sequence[str], seed: int, metric: str, sign: float = 1.0) -> Row | None:
        """New minus old in dB, times ``sign``, paired over scenes; None where nothing was judged."""
        old, new = self.mean(OLD, judges), self.mean(NEW, judges)
        if not old:
            return None
        return mean_row(metric, "dB", [(scene, sign * (new[scene] - old[scene])) for scene in old], seed)

    def rows(self, seed: int) -> Iterator[Row]:
        """Gain on real models, loss on the old test scenes, and PSNR of everything."""
        yield from filter(
            None,
            (
                self.gain(OOD, seed, "variety.ood_gain_db"),
                *(self.gain([judge], seed, f"variety.ood_gain_db.{judge}") for judge in OOD),
                self.gain([HOME], seed, "variety.loss_db", -1.0),
            ),
        )
        for judge in JUDGES:
            for method in (OLD, NEW, LIT):
                if found := self.mean(method, [judge]):
                    yield mean_row(f"variety.psnr.{method}.{judge}", "dB", list(found.items()), seed)

    def sections(self, pictures: Path) -> list[Section]:
        """The two renderers in a table, and side by side."""
        rows = {row.metric: row for row in self.rows(0)}
        table = [
            [
                words,
                *(row_cell(rows.get(f"variety.psnr.{method}.{judge}")) for method in (LIT, OLD, NEW)),
                row_cell(self.gain([judge], 0, "variety.gain"), "strong"),
            ]
            for judge, words in JUDGES.items()
        ]
        caption = (
            f"Foreground PSNR, means over scenes, of the renderer trained on {self.scenes.get(OLD, 0)} "
            f"scenes of the old distribution and of that trained on {self.scenes.get(NEW, 0)} of the new, "
            "for as long; lit is the picture that both start from."
        )
        headings = ["Judged on", "lit", "trained on the old", "trained on the new", "gain"]
        judged = {score.scene for score in self.scores}
        blocks: list[Block] = [Table(caption, headings, table), Text(interval_note(len(judged)))]
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
    stages, found = Stages(folder), Variety()
    datasets = {name: folder / name for name in (OLD, NEW)}
    for name, recipe in ((OLD, settings.old), (NEW, settings.new)):
        child = Child(name, "tron-datagen", [*recipe, f"output_dir={datasets[name]}"])
        stages.run(f"datagen_{name}", [child])
        found.scenes[name] = len(list(datasets[name].glob("scenes/train*/record.json")))
    weights = {}
    for training in settings.seeds:
        children = []
        for name, dataset in datasets.items():
            output = folder / f"train_{name}_{training}"
            weights[name, training] = output / "renderer.safetensors"
            arguments = [*settings.train, f"dataset={dataset}", f"output_dir={output}", f"seed={training}"]
            arguments.append(f"max_seconds={settings.max_seconds:g}")
            children.append(Child(output.name, "tron-train", arguments, ONE_THREAD))
        stages.run(f"train_{training}", children)
    judges = [(HOME, datasets[OLD]), *_make_judges(settings, seed, stages, folder, found)]
    set_torch_threads(1)
    shows = {key: load_network(path).show for key, path in weights.items()}
    for judge, dataset in judges:
        for clip in read_clips(dataset, "test", MEMBERS):
            _score(found, judge, dataset.name, clip, shows, settings.pictures)
    return found


def _make_judges(
    settings: VarietySettings, seed: int, stages: Stages, folder: Path, found: Variety
) -> list[tuple[str, Path]]:
    """Datasets of real models, (judge, folder): one of each model alone, and some of all of them mixed."""
    data = settings.real_data
    if data is None or not all((data / name).is_dir() for name in ("assets", "hdri")):
        log.warning("no assets and hdri in %s: nothing is judged by real models", data)
        return []
    data = data.absolute()
    models, maps = _stems(data / "assets", MODELS), _stems(data / "hdri", MAPS)
    common = [*settings.judge, f"assets={data / 'assets'}", f"environments={data / 'hdri'}"]
    common.append(f"allow_unlicensed=[{','.join((*models, *maps))}]")
    wanted = [
        (ALONE, f"{ALONE}_{model}", [*settings.alone, f"asset_names=[{model}]", f"seed={seed + number}"])
        for number, model in enumerate(models)
    ]
    wanted += [(MIXED, f"{MIXED}_{k}", [*settings.mixed, f"seed={seed + k}"]) for k in range(SIDE_BY_SIDE)]
    children = {
        name: Child(name, "tron-datagen", [*common, *own, "workers=1", f"output_dir={folder / name}"])
        for _, name, own in wanted
    }
    names = list(children)
    for first in range(0, len(names), SIDE_BY_SIDE):
        _make_together(stages, [children[name] for name in names[first : first + SIDE_BY_SIDE]], found)
    return [(judge, folder / name) for judge, name, _ in wanted if name not in found.left_out]


def _stems(folder: Path, suffixes: Sequence[str]) -> list[str]:
    """Names of a folder's files as tron-datagen finds them: with its subfolders, suffixes in any case."""
    return sorted(path.stem for path in folder.rglob("*") if path.suffix.lower() in suffixes)


def _make_together(stages: Stages, children: Sequence[Child], found: Variety) -> None:
    """Make some datasets at once; if one fails each by itself, and what fails then is left out."""
    try:
        stages.run(" ".join(child.label for child in children), children)
    except StageFailed:
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
    shows: Mapping[tuple[str, int], Show],
    pictures: int,
) -> None:
    """Score a clip by every renderer and by lit; the first clips of a judge give pictures as well."""
    buffers, truth = Buffers.of(clip), clip.displayed("rgb")
    inside = region_mask(clip, "foreground")
    scene = f"{dataset}/{clip.meta.scene}"
    shown = {(LIT, 0): buffers.displayed("lit"), **{key: show(buffers) for key, show in shows.items()}}
    for (method, seed), frames in shown.items():
        for image, target, mask in zip(frames, truth, inside):
            if mask.any():
                psnr = metrics.capped_psnr(image, target, mask)
                found.scores.append(Score(judge, scene, method, seed, psnr))
    first = next(iter(shows))[1]
    new_scene = scene not in {each.scene for each in found.examples[judge]}
    if len(found.examples[judge]) < pictures and new_scene and inside[0].any():
        images = {name: shown[name, 0 if name == LIT else first][0] for name in (LIT, OLD, NEW)}
        found.examples[judge].append(Example(scene, clip.meta.light, images, truth[0], inside[0]))


def _comparison(judge: str, example: Example) -> Pictures:
    """Lit and both renderers beside the truth."""
    where = f"scene {example.scene} under light {example.light}"
    titles = {LIT: "lit", OLD: "trained on the old", NEW: "trained on the new"}
    pictures = [
        Picture(
            image,
            titles[name],
            f"{titles[name]}, {where}",
            f"{metrics.capped_psnr(image, example.truth, example.mask):.1f} dB",
            strong=name == NEW,
        )
        for name, image in example.images.items()
    ]
    pictures.append(Picture(example.truth, "path-traced truth", f"path-traced truth, {where}"))
    return Pictures(f"{JUDGES[judge].capitalize()}: {example.scene}", pictures)
