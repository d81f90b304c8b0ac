"""Metrics of every method on every held-out frame, and the rows made of them.

A metric is computed on each displayed frame and then averaged over frames, PSNR too, not of an average
error: a dark, easy frame counts as much as a bright, hard one. A frame that equals the truth has no finite
PSNR and counts as PSNR_CAP of :mod:`tron.metrics`. Intervals are over scenes (:mod:`eval.confidence`), whose
frames and lights are no independent observations; a gain's is of the differences on the same frames.

A new metric is one more entry of METRICS: rows and tables iterate over it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from eval.confidence import Interval, interval, scene_sums
from eval.relighting.baselines import BASELINES, METHODS, Method
from eval.relighting.buffers import REGIONS, Region, region_mask
from eval.results import Row, mean_row
from tron import metrics
from tron.shards.schema import Clip


class Metric(NamedTuple):
    """A figure of one displayed frame against the truth.

    Attributes:
        name: in rows: ``METHOD.NAME``.
        title: in tables, with an arrow to its better side.
        unit: of its rows.
        measure: (image, truth, mask or None) -> the figure; images (H, W, 3) in [0, 1], mask (H, W) bool.
        what: how to read it, a sentence or two.
    """

    name: str
    title: str
    unit: str
    measure: Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]
    what: str


METRICS = (
    Metric(
        "psnr",
        "PSNR ↑",
        "dB",
        metrics.capped_psnr,
        "PSNR says how close a picture is to the truth, in decibels: 20 dB is a typical error of 10% of full "
        "brightness, 30 dB of 3%, and 6 dB more halve it.",
    ),
    Metric("ssim", "SSIM ↑", "1", metrics.ssim, "SSIM compares structure; 1 is identical."),
)
GROUPS = {
    "best_simple_baseline": [baseline.name for baseline in BASELINES if baseline.simple],
    "best_baseline": [baseline.name for baseline in BASELINES],
}
RIVALS = {baseline.name: [baseline.name] for baseline in BASELINES} | GROUPS
"""Names of what the neural renderer's gains are over: each baseline, and the best of each group."""


class Where(NamedTuple):
    """Part of the scores: a region, of all clips, of one family of lights or of one clip."""

    region: Region = "foreground"
    family: str | None = None
    clip: str | None = None

    @property
    def tail(self) -> str:
        """End of the rows' names: ``_full`` for frames, ``.FAMILY`` for one family."""
        return ("_full" if self.region == "frame" else "") + (f".{self.family}" if self.family else "")


ALL = Where()


@dataclass(frozen=True)
class Score:
    """Metric name -> figure of one method on one frame of a clip."""

    family: str
    scene: str
    clip: str
    figures: Mapping[str, float]


@dataclass
class Scores:
    """All scores of an evaluation: (method, region) -> one for each frame."""

    kept: defaultdict[tuple[str, Region], list[Score]] = field(default_factory=lambda: defaultdict(list))

    def add(self, clip: Clip, shown: dict[Region, dict[str, np.ndarray]], truth: np.ndarray) -> None:
        """Score a clip's predictions; a frame without foreground has no foreground score.

        Args:
            clip: its meta and ``foreground`` member are used.
            shown: region -> method -> (K, H, W, 3) display values.
            truth: (K, H, W, 3) display values.
        """
        meta = clip.meta
        for region, images in shown.items():
            inside = region_mask(clip, region)
            for method, frames in images.items():
                for image, target, mask in zip(frames, truth, inside):
                    if mask.any():
                        where = None if region == "frame" else mask
                        figures = {metric.name: metric.measure(image, target, where) for metric in METRICS}
                        score = Score(meta.light_family, meta.scene, meta.key, figures)
                        self.kept[method, region].append(score)

    @property
    def clips(self) -> list[str]:
        """Keys of the clips that were scored, in order."""
        return list(dict.fromkeys(score.clip for scores in self.kept.values() for score in scores))

    @property
    def families(self) -> list[str]:
        """Light families that were scored, sorted."""
        return sorted({score.family for scores in self.kept.values() for score in scores})

    @property
    def methods(self) -> list[Method]:
        """Methods that were scored, in the order of METHODS."""
        scored = {method for method, _ in self.kept}
        return [method for method in METHODS if method.name in scored]

    def of(self, method: str, where: Where) -> list[Score]:
        """A method's scores, in the order of the frames."""
        kept = self.kept.get((method, where.region), ())
        return [s for s in kept if where.family in (None, s.family) and where.clip in (None, s.clip)]

    def psnr(self, method: str, where: Where = ALL) -> float | None:
        """Mean PSNR over frames in dB; None where nothing was scored."""
        scores = self.of(method, where)
        return float(np.mean([score.figures["psnr"] for score in scores])) if scores else None

    def best(self, methods: Sequence[str], where: Where = ALL) -> str | None:
        """The method with the highest mean PSNR; None unless all of them were scored."""
        means = {method: self.psnr(method, where) for method in methods}
        known = {method: mean for method, mean in means.items() if mean is not None}
        return max(known, key=known.__getitem__) if len(known) == len(means) > 0 else None

    def gain(self, methods: Sequence[str], where: Where = ALL) -> float | None:
        """Neural PSNR minus that of the best of the methods, in dB; None unless all were scored."""
        neural, best = self.psnr("neural", where), self.best(methods, where)
        reached = None if best is None else self.psnr(best, where)
        return None if neural is None or reached is None else neural - reached

    def rows(self, seed: int = 0) -> Iterator[Row]:
        """``METHOD.METRIC`` and ``neural.gain_over_RIVAL``, each with the tails of :class:`Where`.

        ``seed`` draws the scenes of the intervals.
        """
        for where in (Where(region, family) for family in (None, *self.families) for region in REGIONS):
            for method in self.methods:
                scores = self.of(method.name, where)
                for metric in METRICS if scores else ():
                    name = f"{method.name}.{metric.name}{where.tail}"
                    found = ((score.scene, score.figures[metric.name]) for score in scores)
                    yield mean_row(name, metric.unit, found, seed)
            for rival, methods in RIVALS.items():
                gain = self.gain(methods, where)
                if gain is not None:
                    name, n = f"neural.gain_over_{rival}{where.tail}", len(self.of("neural", where))
                    row = Row(metric=name, value=gain, unit="dB", n=n)
                    yield row.within(self._gain_interval(methods, where, seed))

    def _gain_interval(self, methods: Sequence[str], where: Where, seed: int) -> Interval:
        """The interval of a gain: in each resample over the method that is the best one there."""
        by_method = [self.of(method, where) for method in ("neural", *methods)]
        psnr = [[score.figures["psnr"] for score in scores] for scores in by_method]
        scenes = [score.scene for score in by_method[0]]
        per_scene = scene_sums(scenes, np.array([*psnr, [1.0] * len(scenes)]).T)

        def gain(sums: np.ndarray) -> np.ndarray:
            neural, rivals, frames = sums[..., 0], sums[..., 1:-1], sums[..., -1]
            return (neural - rivals.max(-1)) / frames

        return interval(per_scene, gain, seed)
