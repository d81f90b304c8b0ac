"""Evidence over views: each surfel's robust mean colour and spread, and the exposure of each photo.

In the logarithm a photo's exposure and white balance add three numbers to all it shows:

    log c_iv = log C_i + log g_v + noise,        sum_v log g_v = 0

C and g are medians in turn: a highlight, a bystander or a silhouette is in few of a surfel's photos.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tron.reconstruction.observations import Observations

FLOOR = 2e-3
"""Linear light below which 8 bits hold no colour."""
_ROUNDS = 6
_TRUSTED = 20.0  # observations that a photo's exposure needs to be half believed


@dataclass(frozen=True)
class Evidence:
    """Colours that photos agree on.

    Attributes:
        color: (M, 3) float32 linear light of each surfel, of the mean photo's exposure: a median over its
            photos; 0 where none shows it.
        spread: (M,) float32, median absolute difference of the logarithms to that.
        count: (M,) int32, photos that show it.
        gain: (V, 3) float32, exposure and white balance of the photos; their mean logarithm is 0.
    """

    color: np.ndarray
    spread: np.ndarray
    count: np.ndarray
    gain: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(M,) bool: surfels that a photo shows."""
        return self.count > 0


def gather_evidence(found: Observations, same_exposure: bool = False) -> Evidence:
    """Means of observations; ``same_exposure`` takes all photos as exposed alike."""
    log = np.log(np.maximum(found.color, FLOOR)).astype(np.float64)
    gain = np.zeros((found.views, 3))
    color = np.zeros((found.surfels, 3))
    by_view = np.argsort(found.view, kind="stable")
    shows = np.bincount(found.view, minlength=found.views)
    usable = ~found.clipped[by_view]
    for _ in range(1 if same_exposure else _ROUNDS):
        color = grouped_median(log - gain[found.view], found.surfel, found.surfels)
        if same_exposure:
            break
        off = (log - color[found.surfel])[by_view][usable]
        gain = grouped_median(off, found.view[by_view][usable], found.views)
        gain *= (shows / (shows + _TRUSTED))[:, None]
        gain -= gain[shows > 0].mean(0) if (shows > 0).any() else 0
    count = np.bincount(found.surfel, minlength=found.surfels)
    off = np.abs(log - gain[found.view] - color[found.surfel]).mean(1)
    spread = grouped_median(off[:, None], found.surfel, found.surfels)[:, 0]
    seen = (count > 0)[:, None]
    return Evidence(
        np.where(seen, np.exp(color), 0).astype(np.float32),
        spread.astype(np.float32),
        count.astype(np.int32),
        np.exp(gain).astype(np.float32),
    )


def grouped_median(values: np.ndarray, group: np.ndarray, groups: int) -> np.ndarray:
    """(groups, C) medians of values (N, C) by group (N,) int, which does not fall; 0 of an empty group."""
    count = np.bincount(group, minlength=groups)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    filled = count > 0
    low, high = (first + (count - 1) // 2)[filled], (first + count // 2)[filled]
    found = np.zeros((groups, values.shape[1]))
    for channel in range(values.shape[1]):
        column = values[np.lexsort((values[:, channel], group)), channel]
        found[filled, channel] = 0.5 * (column[low] + column[high])
    return found
