"""Sharpness: mean squared gradient of a picture over the truth's, in display values.

The gradient is the differences of neighbouring pixels, along rows and along columns. The truth's squared
gradient is the mean product of the gradients of two renders (of every pair, if there are more): their noise
is independent, so the mean product estimates a truth without noise. A picture's noise counts as sharpness:
read it beside the PSNR.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from eval.confidence import interval, scene_sums
from eval.relighting.baselines import DENOISED, NEURAL_LIT
from eval.relighting.scores import Score, Scores, Where
from eval.renderer.truths import Truths
from eval.results import Row
from tron.shards.schema import TARGET, Clip, displayed

OWN, TRUE = "squared_gradient", "true_squared_gradient"
"""Names among the figures of a score."""
BEST_RIVAL = "best_rival"


def gradient_product(a: np.ndarray, b: np.ndarray, inside: np.ndarray) -> float:
    """Return the mean product of two pictures' neighbour differences, along rows plus along columns.

    Args:
        a, b: (H, W, 3).
        inside: (H, W) bool; pairs of neighbours count if both are inside.
    """
    total = 0.0
    for axis in (0, 1):
        products = np.diff(a, axis=axis) * np.diff(b, axis=axis)
        pairs = np.diff(inside.astype(np.int8), axis=axis) == 0
        pairs &= inside[1:] if axis == 0 else inside[:, 1:]
        total += float(products[pairs].mean()) if pairs.any() else 0.0
    return total


@dataclass
class Gradients:
    """Squared gradients of a frame and of its truth, for :attr:`Scores.more`.

    Attributes:
        truths: renders of the clips; clips with a single render have no figures.
    """

    truths: Truths
    _true: dict[tuple[str, int], float] = field(default_factory=dict, init=False, repr=False)

    def __call__(self, clip: Clip, number: int, image: np.ndarray, inside: np.ndarray) -> dict[str, float]:
        """Return the figures of one displayed frame (H, W, 3) on the pixels ``inside`` (H, W)."""
        renders, place = self.truths.renders[clip.meta.key], (clip.meta.key, number)
        if len(renders) < 2:
            return {}
        if place not in self._true:
            shown = [displayed(TARGET, each[number], clip.meta.exposure) for each in renders]
            products = [gradient_product(a, b, inside) for a, b in combinations(shown, 2)]
            self._true[place] = float(np.mean(products))
        return {OWN: gradient_product(image, image, inside), TRUE: self._true[place]}


def sharpness_rows(prefix: str, scores: Scores, rivals: Sequence[str], tail: str, seed: int) -> Iterator[Row]:
    """Yield the sharpness of the network that starts from lit, of lit, each denoiser and the best rival.

    Rows of the network's sharpness over each denoiser's follow.

    Args:
        prefix: prefix of the word sharpness in the rows' names.
        scores: with :class:`Gradients`; without them there are no rows.
        rivals: candidates for the best rival by PSNR.
        tail: end of the names.
        seed: draws the scenes of the intervals.
    """
    denoisers = {name: each.name for name, each in DENOISED.items()}
    methods = (NEURAL_LIT.name, "lit", *denoisers.values())
    found = {name: of for name in methods if (of := _known(scores, name))}
    if (best := scores.best(rivals)) is not None and (of := _known(scores, best)):
        found[BEST_RIVAL] = of
    for name, of in found.items():
        yield from _ratio(f"renderer.{prefix}sharpness.{name}{tail}", of, _figures(of, TRUE), seed)
    for name, method in denoisers.items():
        if {NEURAL_LIT.name, method} <= found.keys():
            ours, theirs = found[NEURAL_LIT.name], _figures(found[method], OWN)
            yield from _ratio(f"renderer.lit.{prefix}sharpness_over_{name}{tail}", ours, theirs, seed)


def _known(scores: Scores, method: str) -> list[Score]:
    return [each for each in scores.of(method, Where()) if OWN in each.figures]


def _figures(scores: Sequence[Score], name: str) -> list[float]:
    return [each.figures[name] for each in scores]


def _ratio(metric: str, scores: Sequence[Score], over: Sequence[float], seed: int) -> Iterator[Row]:
    """Divide two sums of squared gradients: frames of contrast count most, flat ones nothing."""
    sums = np.array([_figures(scores, OWN), over]).T
    if sums[:, 1].sum() <= 0:
        return

    def ratio(sums: np.ndarray) -> np.ndarray:
        return sums[..., 0] / np.maximum(sums[..., 1], 1e-12)

    row = Row(metric=metric, value=float(ratio(sums.sum(0))), unit="x", n=len(sums))
    yield row.within(interval(scene_sums([each.scene for each in scores], sums), ratio, seed))
