"""Shadows that move: whether the network's picture changes where the truth's does, and by as much."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from eval.confidence import Statistic, interval, scene_sums
from eval.relighting.buffers import MEMBERS, Buffers
from eval.renderer.changes import SURFACE, change_sums, correlation, slope, slope_error, stayed
from eval.renderer.networks import TITLES, Network
from eval.renderer.pictures import LEAST_WIDTH, enlarge
from eval.renderer.settings import Kind
from eval.report.charts import density_chart
from eval.report.figures import row_cell
from eval.report.intervals import interval_note
from eval.report.strips import write_strips
from eval.results import Row
from tron.errors import TronError
from tron.report.page import Block, Picture, Pictures, Section, Table, Text
from tron.seeds import generator
from tron.shards.reader import read_clips

log = logging.getLogger("tron.eval")

LIT, PBR = "lit_buffer", "pbr_buffer"
PLAIN = {LIT: "lit, no network", PBR: "pbr, no network"}
POINTS = 2000
"""Values of a clip that the chart shows, drawn at random."""
CHANGE_GAIN = 3
"""Factor on changes in pictures, around middle grey."""


@dataclass(frozen=True)
class Moved:
    """The clip whose truth changes most: (H, W, 3) displays of two frames of a method, and where judged."""

    title: str
    frames: Mapping[str, tuple[np.ndarray, np.ndarray]]
    judged: np.ndarray


@dataclass
class Shadows:
    """Findings.

    Attributes:
        scenes: of each pair of frames.
        sums: method -> sums (6,) of each pair of frames; methods are LIT, PBR and kinds of checkpoint.
        points: method -> (n, 2) changes of the truth and of the method, for the chart.
        example: a pair of frames that is shown.
    """

    scenes: list[str] = field(default_factory=list)
    sums: defaultdict[str, list[np.ndarray]] = field(default_factory=lambda: defaultdict(list))
    points: defaultdict[str, list[np.ndarray]] = field(default_factory=lambda: defaultdict(list))
    example: Moved | None = None

    def rows(self, seed: int) -> Iterator[Row]:
        """Correlation and slope of every method.

        Figures without a name are of the checkpoint that starts from lit, the default of tron-relight.
        """
        for method in self.sums:
            for what, measure in (("correlation", correlation), ("slope", slope)):
                yield self._row(f"renderer.{method}.shadow_{what}", method, measure, seed)
        if "lit" in self.sums:
            yield self._row("renderer.shadow_correlation", "lit", correlation, seed)
            yield self._row("renderer.shadow_slope", "lit", slope, seed)
            yield self._row("renderer.shadow_slope_error", "lit", slope_error, seed)

    def sections(self, pictures: Path) -> list[Section]:
        """A table, a chart for each method, and the clip that changes most."""
        rows = [
            [
                _title(method),
                row_cell(self._row("a.b", method, correlation, 0), "strong"),
                row_cell(self._row("a.b", method, slope, 0)),
            ]
            for method in self.sums
        ]
        text = Text(
            "An occluder moves between two frames; camera and light stand still. Over foreground pixels "
            "whose true depth, normal and base color are unchanged, the change of displayed values is held "
            "against the truth's: 1 and 1 is perfect, 0 a picture that does not react. The truth's own "
            f"noise keeps correlation below 1. {interval_note(len(set(self.scenes)))}"
        )
        caption = f"Change of the picture against the truth's, {len(self.scenes)} pairs of frames."
        blocks: list[Block] = [text, Table(caption, ["Method", "correlation", "slope"], rows)]
        shown = {_title(name): np.concatenate(self.points[name]) for name in self.sums if name != PBR}
        blocks.append(
            density_chart(
                shown,
                "change of the truth, display values",
                "change of the picture",
                "Each cell's shade: how many values lie there, logarithmic. Dotted: both change alike.",
            )
        )
        if self.example is not None:
            group = _moved(self.example)
            write_strips([group], ["renderer-shadows"], pictures)
            blocks.append(group)
        return [Section("shadows", "Shadows that move", blocks)]

    def _row(self, metric: str, method: str, measure: Statistic, seed: int) -> Row:
        sums = np.stack(self.sums[method])
        row = Row(metric=metric, value=float(measure(sums.sum(0))), unit="1", n=len(sums))
        return row.within(interval(scene_sums(self.scenes, sums), measure, seed))


def measure_shadows(
    dataset: Path, split: str, networks: Mapping[Kind, Network], window: int, seed: int
) -> Shadows:
    """Compare consecutive frames of every clip.

    Raises:
        TronError: clips hold no references, or no surface stays where the truth changes.
    """
    found, largest = Shadows(), 0.0
    for clip in read_clips(dataset, split, (*MEMBERS, *SURFACE)):
        if missing := [name for name in SURFACE if name not in clip.frames]:
            raise TronError(
                f"clip {clip.meta.key} has no {missing[0]}", dataset, "make it with reference_buffers=true"
            )
        buffers, truth = Buffers.of(clip), clip.displayed("rgb")
        shown = {PBR: buffers.displayed("pbr"), LIT: buffers.displayed("lit")}
        shown |= {kind: network.clip(buffers, window) for kind, network in networks.items()}
        for now in range(1, clip.meta.frames):
            judged = stayed(clip, now - 1, now)
            if not judged.any():
                continue
            change = (truth[now] - truth[now - 1])[judged]
            rng = generator(seed, "eval", "shadows", clip.meta.key, now)
            some = rng.choice(change.size, min(POINTS, change.size), replace=False)
            found.scenes.append(clip.meta.scene)
            for method, frames in shown.items():
                ours = (frames[now] - frames[now - 1])[judged]
                found.sums[method].append(change_sums(change, ours))
                found.points[method].append(np.stack([change.ravel()[some], ours.ravel()[some]], 1))
            if (strength := float((change**2).sum())) > largest:
                largest = strength
                pair = {name: (frames[now - 1], frames[now]) for name, frames in shown.items()}
                pair["truth"] = (truth[now - 1], truth[now])
                found.example = Moved(f"Scene {clip.meta.scene}, light {clip.meta.light}", pair, judged)
        log.info("changes of clip %s", clip.meta.key)
    if not found.scenes:
        raise TronError("no clip with two frames in which a surface stays", dataset)
    return found


def _title(method: str) -> str:
    titles: dict[str, str] = {**PLAIN, **TITLES, "truth": "path-traced truth"}
    return titles[method]


def _moved(example: Moved) -> Pictures:
    """Two frames and their change, by every method but pbr; three columns, a method a row."""
    pictures = []
    scale = -(-LEAST_WIDTH // example.judged.shape[1])
    order: Sequence[str] = [name for name in example.frames if name != PBR]
    for name in order:
        before, now = example.frames[name]
        change = np.clip(0.5 + CHANGE_GAIN * (now - before) / 2, 0, 1)
        change = np.where(example.judged[..., None], change, 0.5)
        for image, what in ((before, "before"), (now, "after"), (change, "change, surface that stayed")):
            title = f"{_title(name)}: {what}"
            pictures.append(Picture(enlarge(image, scale), title, title))
    return Pictures(example.title, pictures, columns=3)
