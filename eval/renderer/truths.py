"""Truth from several path-traced renders: their mean, and its remaining noise.

Data sets of one recipe at two qualities have the same frames. If their samples per pass differ, their paths
are independent (errors of 90, 100 and 110 samples in one pass correlate by 0.0 to 0.13). The mean of both
renders is then a better truth than either, and their difference gives the remaining noise of the mean, which
bounds the score of a perfect picture.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from eval.relighting.buffers import REGIONS, Region, region_mask
from eval.results import Row, mean_row
from tron import metrics
from tron.errors import TronError
from tron.shards.reader import read_clips
from tron.shards.schema import TARGET, Clip, displayed

TRUTH = "truth"
"""What its rows call it."""


@dataclass
class Truths:
    """Renders of a split's frames.

    Attributes:
        renders: key of a clip -> (K, H, W, 3) float32 each, linear.
    """

    renders: dict[str, list[np.ndarray]] = field(default_factory=dict)

    @classmethod
    def of(cls, datasets: Iterable[Path], split: str) -> Truths:
        """Collect the renders of all data sets; bitwise equal renders count once.

        Raises:
            TronError: the data sets do not have the same frames.
        """
        found, cameras = cls(), {}
        for dataset in datasets:
            for clip in read_clips(dataset, split, (TARGET,)):
                key, rgb = clip.meta.key, clip.frames[TARGET]
                if cameras.setdefault(key, clip.meta.cameras) != clip.meta.cameras:
                    raise TronError(f"clip {key} shows other frames than in the data sets beside it", dataset)
                known = found.renders.setdefault(key, [])
                if not any(np.array_equal(rgb, each) for each in known):
                    known.append(rgb)
        return found

    def linear(self, clip: Clip) -> np.ndarray:
        """Return the mean of the renders of a clip: (K, H, W, 3) linear."""
        return np.mean(self.renders[clip.meta.key], axis=0)

    def displayed(self, clip: Clip) -> np.ndarray:
        """Return the mean of the renders in display values, with the clip's exposure."""
        return displayed(TARGET, self.linear(clip), clip.meta.exposure)

    def rows(self, clips: Iterable[Clip], metric: str, tail: str, seed: int) -> list[Row]:
        """Return rows of a perfect picture's PSNR against the mean, from the mean's noise in display values.

        Args:
            clips: judged clips, with ``foreground``; clips with one render are ignored.
            metric, tail: beginning and end of the rows' name; the region's tail stands between.
            seed: draws the scenes of the intervals.
        """
        found: dict[Region, list[tuple[str, float]]] = {region: [] for region in REGIONS}
        for clip in clips:
            renders = self.renders[clip.meta.key]
            if len(renders) < 2:
                continue
            noise = mean_noise([displayed(TARGET, each, clip.meta.exposure) for each in renders])
            for region, psnrs in found.items():
                for error, inside in zip(noise, region_mask(clip, region)):
                    if inside.any():
                        psnr = metrics.capped_psnr(np.sqrt(error), np.zeros_like(error), inside)
                        psnrs.append((clip.meta.scene, psnr))
        tails = {"foreground": tail, "frame": f"_full{tail}"}
        return [
            mean_row(f"{metric}{tails[region]}", "dB", psnrs, seed)
            for region, psnrs in found.items()
            if psnrs
        ]


def mean_noise(renders: Sequence[np.ndarray]) -> np.ndarray:
    """Estimate the squared error of the mean of renders: their unbiased variance over their number."""
    return np.var(np.stack(renders).astype(np.float64), axis=0, ddof=1) / len(renders)
