"""PSNR and SSIM of every method on every held-out frame, and the rows made of them.

PSNR is computed on each displayed frame against a peak of 1 and then averaged over frames, not of an average
error: a dark, easy frame counts as much as a bright, hard one. SSIM likewise. A frame that equals the truth
    has no finite PSNR and counts as PSNR_CAP.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from eval.baselines import SEVEN, THREE
from eval.predictions import REGIONS, Region, region_mask
from eval.results import Row
from tron import metrics
from tron.shards.schema import Clip

PSNR_CAP = 100.0
METHODS = ("neural", *SEVEN)
GROUPS = {"best_of_three": THREE, "best_of_seven": SEVEN}
SUFFIX: dict[Region, str] = {"foreground": "", "frame": "_full"}
"""Full-frame metrics carry ``_full`` after their name, foreground metrics nothing."""


@dataclass(frozen=True)
class Score:
    """One method on one region of one frame: psnr in dB (capped), ssim in [-1, 1]."""

    method: str
    region: Region
    family: str
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
                        clip.meta.key,
                        k,
                        min(metrics.psnr(image, target, where), PSNR_CAP),
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
        values = [
            getattr(score, metric)
            for score in self._kept.get((method, region), ())
            if family in (None, score.family) and clip in (None, score.clip)
        ]
        return (float(np.mean(values)), len(values)) if values else None

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

    def rows(self) -> list[Row]:
        """``METHOD.psnr``, ``METHOD.ssim`` and ``neural.gain_over_*``; ``_full`` for frames, ``.FAMILY`` for
        one.
        """
        rows: list[Row] = []

        def add(name: str, mean: tuple[float, int] | None, unit: str) -> None:
            if mean is not None:
                rows.append(Row(metric=name, value=mean[0], unit=unit, n=mean[1]))

        for family in (None, *self.families):
            tail = "" if family is None else f".{family}"
            for region in REGIONS:
                for method in self.methods:
                    for metric, unit in (("psnr", "dB"), ("ssim", "1")):
                        name = f"{method}.{metric}{SUFFIX[region]}{tail}"
                        add(name, self.mean(method, region, family, metric), unit)
                for group, methods in GROUPS.items():
                    name = f"neural.gain_over_{group}{SUFFIX[region]}{tail}"
                    add(name, self.gain(methods, region, family), "dB")
        return rows
