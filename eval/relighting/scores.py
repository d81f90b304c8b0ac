"""PSNR and SSIM of every method on every held-out frame, and the rows made of them.

PSNR is computed on each displayed frame against a peak of 1 and then averaged over frames, not of an average
error: a dark, easy frame counts as much as a bright, hard one. SSIM likewise. A frame that equals the truth
has no finite PSNR and counts as PSNR_CAP of :mod:`tron.metrics`. Intervals are over scenes
(:mod:`eval.confidence`), whose frames and lights are no independent observations; a gain's is of the
differences on the same frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from eval.confidence import Interval, interval, mean_interval, scene_sums
from eval.relighting.baselines import SEVEN, THREE
from eval.relighting.predictions import REGIONS, Region, region_mask
from eval.results import Row
from tron import metrics
from tron.shards.schema import Clip

METHODS = ("neural", *SEVEN)
GROUPS = {"best_of_three": THREE, "best_of_seven": SEVEN}
RIVALS: dict[str, Sequence[str]] = {**{method: (method,) for method in SEVEN}, **GROUPS}
"""What the neural renderer's gains are over: each baseline, and the best of each group."""
SUFFIX: dict[Region, str] = {"foreground": "", "frame": "_full"}
"""Full-frame metrics carry ``_full`` after their name, foreground metrics nothing."""


@dataclass(frozen=True)
class Score:
    """One method on one region of one frame: psnr in dB (capped), ssim in [-1, 1]."""

    method: str
    region: Region
    family: str
    scene: str
    clip: str
    frame: int
    psnr: float
    ssim: float


@dataclass
class Scores:
    """All scores of an evaluation, kept by method and region."""

    _kept: dict[tuple[str, Region], list[Score]] = field(default_factory=dict)

    def add(self, clip: Clip, shown: dict[Region, dict[str, np.ndarray]], truth: np.ndarray) -> None:
        """Score a clip's predictions; a frame without foreground has no foreground score.

        Args:
            clip: its meta and ``foreground`` member are used.
            shown: region -> method -> (K, H, W, 3) display values.
            truth: (K, H, W, 3) display values.
        """
        for region, images in shown.items():
            inside = region_mask(clip, region)
            for method, frames in images.items():
                for k, (image, target, mask) in enumerate(zip(frames, truth, inside)):
                    if not mask.any():
                        continue
                    where = None if region == "frame" else mask
                    score = Score(
                        method,
                        region,
                        clip.meta.light_family,
                        clip.meta.scene,
                        clip.meta.key,
                        k,
                        metrics.capped_psnr(image, target, where),
                        metrics.ssim(image, target, where),
                    )
                    self._kept.setdefault((method, region), []).append(score)

    @property
    def entries(self) -> list[Score]:
        """Every score, method by method."""
        return [score for scores in self._kept.values() for score in scores]

    @property
    def families(self) -> list[str]:
        """Light families seen, sorted."""
        return sorted({score.family for score in self.entries})

    @property
    def methods(self) -> list[str]:
        """Methods seen, in the order of METHODS."""
        seen = {method for method, _ in self._kept}
        return [method for method in METHODS if method in seen]

    def mean(
        self,
        method: str,
        region: Region = "foreground",
        family: str | None = None,
        metric: str = "psnr",
        clip: str | None = None,
    ) -> tuple[float, int] | None:
        """Mean over frames and the number of frames; None where nothing was scored."""
        values = [getattr(score, metric) for score in self._of(method, region, family, clip)]
        return (float(np.mean(values)), len(values)) if values else None

    def _of(self, method: str, region: Region, family: str | None, clip: str | None = None) -> list[Score]:
        kept = self._kept.get((method, region), ())
        return [score for score in kept if family in (None, score.family) and clip in (None, score.clip)]

    def best(
        self, methods: Iterable[str], region: Region, family: str | None = None, clip: str | None = None
    ) -> tuple[str, float] | None:
        """The method with the highest mean PSNR and that PSNR; None unless all of them were scored."""
        means = {method: self.mean(method, region, family, clip=clip) for method in methods}
        if not all(means.values()):
            return None
        return max(((name, mean[0]) for name, mean in means.items() if mean), key=lambda pair: pair[1])

    def gain(
        self, group: Iterable[str], region: Region, family: str | None = None, clip: str | None = None
    ) -> tuple[float, int] | None:
        """Neural PSNR minus that of the best method of the group, in dB, and the number of frames."""
        neural, best = self.mean("neural", region, family, clip=clip), self.best(group, region, family, clip)
        return (neural[0] - best[1], neural[1]) if neural and best else None

    def rows(self, seed: int = 0) -> list[Row]:
        """``METHOD.psnr``, ``METHOD.ssim`` and ``neural.gain_over_*``; ``_full`` for frames, ``.FAMILY`` for
        one. ``seed`` draws the scenes of the intervals.
        """
        rows: list[Row] = []
        for family in (None, *self.families):
            tail = "" if family is None else f".{family}"
            for region in REGIONS:
                for method in self.methods:
                    for metric, unit in (("psnr", "dB"), ("ssim", "1")):
                        mean = self.mean(method, region, family, metric)
                        if mean is not None:
                            name = f"{method}.{metric}{SUFFIX[region]}{tail}"
                            row = Row(metric=name, value=mean[0], unit=unit, n=mean[1])
                            scores = self._of(method, region, family)
                            scenes = [score.scene for score in scores]
                            values = [getattr(score, metric) for score in scores]
                            rows.append(row.within(mean_interval(scenes, values, seed)))
                for rival, methods in RIVALS.items():
                    gain = self.gain(methods, region, family)
                    if gain is not None:
                        name = f"neural.gain_over_{rival}{SUFFIX[region]}{tail}"
                        row = Row(metric=name, value=gain[0], unit="dB", n=gain[1])
                        rows.append(row.within(self._gain_interval(methods, region, family, seed)))
        return rows

    def _gain_interval(self, group: Sequence[str], region: Region, family: str | None, seed: int) -> Interval:
        """The interval of a gain: in each resample over the method that is the best one there."""
        compared = ("neural", *group)
        by_method = [self._of(method, region, family) for method in compared]
        psnr = [[score.psnr for score in scores] for scores in by_method]
        scenes = [score.scene for score in by_method[0]]
        per_scene = scene_sums(scenes, np.array([*psnr, [1.0] * len(scenes)]).T)

        def gain(sums: np.ndarray) -> np.ndarray:
            neural, rivals, frames = sums[..., 0], sums[..., 1:-1], sums[..., -1]
            return (neural - rivals.max(-1)) / frames

        return interval(per_scene, gain, seed)
