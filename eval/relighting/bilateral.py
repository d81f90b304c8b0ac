"""A cross-bilateral filter of ``lit``, guided by base color, by the surface and by filtered ``lit``.

It is a denoiser without a network (Eisemann and Durand 2004; Petschnigg et al. 2004): neighbours are weighted
by distance and by similarity of their guides,

    w = exp(-d² / 2 s²) exp(-(|A - A'|² / a² + |S - S'|² / b² + |G - G'|² / c²) / 2 k²)

with A and S base color and surface as displayed, G the displayed lit filtered by a Gaussian of SMOOTHED, and
a, b, c of ALIKE. s and k are chosen by the mean PSNR of the middle frames of the training clips.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import scipy.ndimage

from eval.relighting.buffers import Buffers
from eval.relighting.fits import Fitted
from tron.metrics import capped_psnr

DEVIATIONS = (0.7, 1.0, 1.5, 2.0)
"""s, pixels."""
TOLERANCES = (0.5, 1.0, 2.0, 4.0)
"""k."""
ALIKE = {"albedo": 0.1, "surface": 0.15, "lit": 0.06}
"""Differences of the guides that count as one standard deviation at k = 1, display values."""
SMOOTHED = 1.0
"""Deviation, pixels, of the Gaussian that lit leads by: one sample a pixel is too noisy to lead."""
REACH = 3
"""Pixels to either side that the filter reads."""


def bilateral(buffers: Buffers, settings: np.ndarray) -> np.ndarray:
    """Filter displayed lit of whole clips with several settings.

    Args:
        buffers: buffers of images (K, H, W, C).
        settings: (n, 2), pairs of s and k.

    Returns:
        (n, K, H, W, 3) float32 display values.
    """
    lit = buffers.displayed("lit")
    smooth = scipy.ndimage.gaussian_filter(lit, (0, SMOOTHED, SMOOTHED, 0), mode="nearest")
    guides = np.concatenate(
        [
            buffers.displayed("albedo") / ALIKE["albedo"],
            buffers.displayed("surface") / ALIKE["surface"],
            smooth / ALIKE["lit"],
        ],
        axis=-1,
    )
    edge = ((0, 0), (REACH, REACH), (REACH, REACH), (0, 0))
    padded, led = (np.pad(image, edge, mode="edge") for image in (lit, guides))
    height, width = lit.shape[1:3]
    total = np.zeros((len(settings), *lit.shape), np.float32)
    weights = np.zeros((len(settings), *lit.shape[:3], 1), np.float32)
    for dy in range(-REACH, REACH + 1):
        for dx in range(-REACH, REACH + 1):
            there = np.s_[:, REACH + dy : REACH + dy + height, REACH + dx : REACH + dx + width]
            apart = np.square(led[there] - guides).sum(-1, keepdims=True)
            for way, (deviation, tolerance) in enumerate(settings):
                near = (dx * dx + dy * dy) / (2 * deviation**2)
                weight = np.exp(-near - apart / (2 * tolerance**2))
                weights[way] += weight
                total[way] += weight * padded[there]
    return total / weights


class BilateralFit:
    """The filter of DEVIATIONS and TOLERANCES with the highest mean PSNR; needs whole clips."""

    sampled: ClassVar[bool] = False
    SETTINGS = np.array([(s, k) for s in DEVIATIONS for k in TOLERANCES])

    def __init__(self):
        self._psnr: list[np.ndarray] = []

    def add(self, buffers: Buffers, truth: np.ndarray, inside: Any = ...) -> None:
        """As Fit.add, for the clip's middle frame; a frame without foreground is ignored."""
        middle = len(truth) // 2
        mask = np.zeros(truth.shape[:3], bool)
        mask[inside] = True
        if not mask[middle].any():
            return
        shown = bilateral(buffers.at(np.s_[middle : middle + 1]), self.SETTINGS)[:, 0]
        self._psnr.append(np.array([capped_psnr(image, truth[middle], mask[middle]) for image in shown]))

    def solve(self) -> Fitted:
        """Return s and k, (2,)."""
        mean = np.mean(self._psnr, axis=0) if self._psnr else np.zeros(len(self.SETTINGS))
        chosen = self.SETTINGS[int(np.argmax(mean))]
        return Fitted(lambda buffers: bilateral(buffers, chosen[None])[0], chosen)
