"""Metrics of every method on every held-out frame, and their rows.

A metric is computed on each displayed frame and then averaged over frames. PSNR is averaged too, not computed
from a mean error: a dark, easy frame counts as much as a bright, hard one. A frame that equals the truth has
no finite PSNR and counts as PSNR_CAP of :mod:`tron.metrics`. Intervals are over scenes
(:mod:`eval.confidence`), whose frames and lights are no independent observations; a gain's is of the
differences on the same frames.

A new metric is one more entry of METRICS: rows and tables iterate over it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from eval.confidence import interval, scene_sums, without_one
from eval.relighting.baselines import (
    BASELINES,
    DIRECT,
    FINER,
    METHODS,
    NETWORKS,
    NEURAL,
    NEURAL_LIT,
    ON_LIT,
    SIMPLE,
    Method,
)
from eval.relighting.buffers import MATERIALS, REGIONS, Region, region_mask
from eval.relighting.flip import INSTALLED, flip
from eval.results import Row, mean_row
from tron import metrics
from tron.shards.schema import Clip


class Metric(NamedTuple):
    """A figure of one displayed frame against the truth.

    Attributes:
        name: name in rows: ``METHOD.NAME``.
        title: title in tables, with an arrow for the better side.
        unit: unit of the rows.
        measure: (image, truth, mask or None) -> the figure; images (H, W, 3) in [0, 1], mask (H, W) bool.
        what: how to read it, a sentence or two.
        better: the good side; gains are towards it.
        regions: regions of the measurement.
    """

    name: str
    title: str
    unit: str
    measure: Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]
    what: str
    better: Literal["more", "less"] = "more"
    regions: tuple[Region, ...] = REGIONS


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
    *(
        [
            Metric(
                "flip",
                "FLIP ↓",
                "1",
                flip,
                "FLIP is the difference that one sees where two pictures alternate; 0 is none.",
                "less",
                ("foreground",),  # half a second a frame of 512 x 512
            )
        ]
        if INSTALLED
        else []
    ),
)
LEAST_PIXELS = 64
"""Pixels of a material that a frame needs to be judged by it."""
UNITS = {metric.name: metric.unit for metric in METRICS}
SIGNS = {metric.name: 1 if metric.better == "more" else -1 for metric in METRICS}
"""What makes more the better side."""
BEST_OF_ALL = "best_of_all"
"""Group of everything but the networks that are judged, dearer forms of lit included: the best is of those
that were scored, whatever was not given."""
GROUPS = {
    **{
        group: [each.name for each in BASELINES if group in each.groups] for group in (SIMPLE, DIRECT, ON_LIT)
    },
    "best_baseline": [baseline.name for baseline in BASELINES],
    BEST_OF_ALL: [each.name for each in (*BASELINES, *FINER)],
}
OPTIONAL = {baseline.name for baseline in BASELINES if baseline.optional}
RIVALS = {each.name: [each.name] for each in (*BASELINES, *FINER)} | GROUPS
"""Names of what a network's gains are over: each method without it, and the best of each group."""
GAINS: dict[str, dict[str, list[str]]] = {
    NEURAL_LIT.name: RIVALS | {NEURAL.name: [NEURAL.name]},
    NEURAL.name: RIVALS,
    "lit": {"shadowed": ["shadowed"]},
}
"""Method -> what its gains are over."""


class Where(NamedTuple):
    """Selection of scores: a region in all clips, or in one light family, one style of scene, or one clip."""

    region: Region = "foreground"
    family: str | None = None
    clip: str | None = None
    style: str | None = None

    @property
    def tail(self) -> str:
        """End of rows' names: ``_full`` (full frames), ``_metal``, ``_rest``; ``.FAMILY`` or ``.STYLE``."""
        return self.tail_after("")

    def tail_after(self, size: str) -> str:
        """End of the rows' names with something between the region and the kind."""
        kind = self.family or self.style
        region = {"foreground": "", "frame": "_full"}.get(self.region, f"_{self.region}")
        return region + size + (f".{kind}" if kind else "")


ALL = Where()


@dataclass(frozen=True)
class Score:
    """Figures of one method on one frame of a clip, by metric."""

    family: str
    scene: str
    clip: str
    figures: Mapping[str, float]
    style: str = ""


@dataclass
class Scores:
    """All scores of an evaluation.

    Attributes:
        kept: (method, region) -> a score for each frame.
        tail: end of the rows' names, after the tail of :class:`Where`.
        materials: whether PSNRs of MATERIALS are computed too.
        more: function for further foreground figures, of (clip, number of the frame, picture, pixels).
    """

    tail: str = ""
    materials: bool = False
    more: Callable[[Clip, int, np.ndarray, np.ndarray], Mapping[str, float]] | None = None
    kept: defaultdict[tuple[str, Region], list[Score]] = field(default_factory=lambda: defaultdict(list))

    def add(self, clip: Clip, shown: dict[Region, dict[str, np.ndarray]], truth: np.ndarray) -> None:
        """Score a clip's predictions; a frame without foreground has no foreground score.

        Args:
            clip: its meta and ``foreground`` member are used; for materials ``surface`` too.
            shown: region -> method -> (K, H, W, 3) display values.
            truth: (K, H, W, 3) display values.
        """
        if self.materials:
            shown = {**shown, **dict.fromkeys(MATERIALS, shown["foreground"])}
        for region, images in shown.items():
            inside = region_mask(clip, region)
            for method, frames in images.items():
                for number, (image, target, mask) in enumerate(zip(frames, truth, inside)):
                    if mask.sum() >= (LEAST_PIXELS if region in MATERIALS else 1):
                        self._add(clip, region, method, number, image, target, mask)

    def _add(
        self,
        clip: Clip,
        region: Region,
        method: str,
        number: int,
        image: np.ndarray,
        target: np.ndarray,
        inside: np.ndarray,
    ) -> None:
        meta, style = clip.meta, str(clip.meta.extra.get("style", ""))
        if region in MATERIALS:
            figures = {"psnr": metrics.capped_psnr(image, target, inside)}
        else:
            there = [metric for metric in METRICS if region in metric.regions]
            mask = None if region == "frame" else inside
            figures = {metric.name: metric.measure(image, target, mask) for metric in there}
        if self.more is not None and region == "foreground":
            figures |= self.more(clip, number, image, inside)
        self.kept[method, region].append(Score(meta.light_family, meta.scene, meta.key, figures, style))

    @property
    def clips(self) -> list[str]:
        """Keys of the scored clips, in order."""
        return list(dict.fromkeys(score.clip for scores in self.kept.values() for score in scores))

    @property
    def families(self) -> list[str]:
        """Light families of the scored clips, sorted."""
        return sorted({score.family for scores in self.kept.values() for score in scores})

    @property
    def styles(self) -> list[str]:
        """Styles of the scored scenes, sorted; none if all have the same style."""
        found = sorted({score.style for scores in self.kept.values() for score in scores})
        return found if len(found) > 1 else []

    @property
    def methods(self) -> list[Method]:
        """Scored methods, in the order of METHODS."""
        scored = {method for method, _ in self.kept}
        return [method for method in METHODS if method.name in scored]

    def of(self, method: str, where: Where) -> list[Score]:
        """Return a method's scores, in the order of the frames."""
        kept = self.kept.get((method, where.region), ())
        return [
            s
            for s in kept
            if where.family in (None, s.family)
            and where.clip in (None, s.clip)
            and where.style in (None, s.style)
        ]

    def psnr(self, method: str, where: Where = ALL) -> float | None:
        """Return the mean PSNR over frames in dB; None if nothing was scored."""
        return self.mean(method, where)

    def mean(self, method: str, where: Where = ALL, figure: str = "psnr") -> float | None:
        """Return the mean of a metric over frames, in its unit; None if nothing was scored."""
        scores = self.of(method, where)
        return float(np.mean([score.figures[figure] for score in scores])) if scores else None

    @property
    def network(self) -> Method | None:
        """The main network of the report: the network with lit as guidance, if it was scored."""
        return next((method for method in self.methods if method in NETWORKS), None)

    def best(self, methods: Sequence[str], where: Where = ALL, figure: str = "psnr") -> str | None:
        """Return the method with the best mean of a metric; None unless all but OPTIONAL ones were scored.

        For BEST_OF_ALL it is the best of the scored methods.
        """
        means = {method: self.mean(method, where, figure) for method in methods}
        known = {method: mean for method, mean in means.items() if mean is not None}
        missing = set() if methods == GROUPS[BEST_OF_ALL] else means.keys() - known.keys() - OPTIONAL
        best = max(known, key=lambda method: SIGNS[figure] * known[method], default=None)
        return None if missing else best

    def gain(
        self, method: str, over: Sequence[str], where: Where = ALL, figure: str = "psnr"
    ) -> float | None:
        """Return the gain of a method in the mean of a metric over the best of others.

        None if either mean is unknown.
        """
        ours, best = self.mean(method, where, figure), self.best(over, where, figure)
        reached = None if best is None else self.mean(best, where, figure)
        return None if ours is None or reached is None else SIGNS[figure] * (ours - reached)

    def rows(self, seed: int = 0) -> Iterator[Row]:
        """Yield rows ``METHOD.METRIC`` and ``METHOD.gain_over_RIVAL`` of GAINS, with :class:`Where`'s tails.

        ``seed`` draws the scenes of the intervals.
        """
        parts = [(family, None) for family in (None, *self.families)]
        parts += [(None, style) for style in self.styles]
        for where in (Where(region, kind, style=style) for kind, style in parts for region in REGIONS):
            for method in self.methods:
                scores = self.of(method.name, where)
                for metric in METRICS if scores else ():
                    if where.region not in metric.regions:
                        continue
                    name = f"{method.name}.{metric.name}{where.tail}{self.tail}"
                    found = ((score.scene, score.figures[metric.name]) for score in scores)
                    yield mean_row(name, metric.unit, found, seed)
            for method, rivals in GAINS.items():
                for rival, over in rivals.items():
                    name = f"{method}.gain_over_{rival}{where.tail}{self.tail}"
                    if row := self.gain_row(name, method, over, where, seed):
                        yield row

    def gain_row(
        self,
        metric: str,
        method: str,
        over: Sequence[str],
        where: Where = ALL,
        seed: int = 0,
        figure: str = "psnr",
    ) -> Row | None:
        """Return the gain of a method over the best of others as a named row; None if either is unknown."""
        gain = self.gain(method, over, where, figure)
        if gain is None:
            return None
        row = Row(metric=metric, value=gain, unit=UNITS[figure], n=len(self.of(method, where)))
        return self._with_ranges(row, method, over, where, seed, figure)

    def mean_row(
        self, metric: str, method: str, where: Where = ALL, seed: int = 0, figure: str = "psnr"
    ) -> Row | None:
        """Return the mean of a method's metric as a named row; None if nothing was scored."""
        found = [(score.scene, score.figures[figure]) for score in self.of(method, where)]
        return mean_row(metric, UNITS[figure], found, seed) if found else None

    def scene_gains(self, method: str, over: Sequence[str], where: Where = ALL) -> dict[str, float]:
        """Return scene -> mean PSNR of a method minus the PSNR of the best other method in that scene, dB."""
        means: dict[str, dict[str, float]] = {}
        for name in (method, *over):
            by_scene = defaultdict[str, list[float]](list)
            for score in self.of(name, where):
                by_scene[score.scene].append(score.figures["psnr"])
            for scene, found in by_scene.items():
                means.setdefault(scene, {})[name] = float(np.mean(found))
        return {
            scene: found.pop(method) - max(found.values())
            for scene, found in means.items()
            if method in found and len(found) > 1
        }

    def _with_ranges(
        self, row: Row, method: str, over: Sequence[str], where: Where, seed: int, figure: str
    ) -> Row:
        """Return the gain with its interval; each resample compares with the best other method in it.

        The range with one scene left out is computed in the same way.
        """
        by_method = [scores for name in (method, *over) if (scores := self.of(name, where))]
        sign = SIGNS[figure]
        found = [[sign * score.figures[figure] for score in scores] for scores in by_method]
        scenes = [score.scene for score in by_method[0]]
        per_scene = scene_sums(scenes, np.array([*found, [1.0] * len(scenes)]).T)

        def gain(sums: np.ndarray) -> np.ndarray:
            ours, others, frames = sums[..., 0], sums[..., 1:-1], sums[..., -1]
            return (ours - others.max(-1)) / frames

        ranges = {"without_one": without_one(per_scene, gain)}
        return row.within(interval(per_scene, gain, seed)).model_copy(update=ranges)
