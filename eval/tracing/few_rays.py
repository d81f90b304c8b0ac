"""Irradiance of a preview's few rays, filtered and not: is a shadow as dark as it should be, and how noisy?

A biased estimator can have little noise, and the filter hides what noise there is: so beside the error stands
the mean over the pixels in shadow, as a share of the reference's there.
"""

from __future__ import annotations

import numpy as np

from eval.peers.contenders import Contenders
from eval.relighting.shadows import shadow_pixels
from eval.tracing.irradiance import LitView
from eval.tracing.measured import FewRays
from tron.color import luminance

RAYS = (2, 4, 8)
TRIALS = 4
REFERENCE_SPP = 1024
"""Most rays per pixel of the reference: where it is compared, 4 trials of 8 rays are 30 times as noisy."""


def measure_few_rays(contenders: Contenders, size: int, light: str, reference_spp: int, seed: int) -> FewRays:
    """Render ``size`` x ``size`` pixels with few rays, ``TRIALS`` times each way, and hold them to many."""
    lit = LitView(contenders, size, light, min(reference_spp, REFERENCE_SPP), seed)
    truth = lit.truth.irradiance
    shadowed = shadow_pixels(truth, truth, lit.truth.unshadowed, lit.surface).shadowed
    trials = {
        f"{rays}.filtered" if filtered else f"{rays}": lit.trials(TRIALS, rays, filtered)
        for rays in RAYS
        for filtered in (False, True)
    }
    mean = {way: mean_over_reference(images, truth, shadowed) for way, images in trials.items()}
    rmse = {way: lit.rmse(images) for way, images in trials.items()}
    return FewRays(lit.images(trials), TRIALS, mean, rmse)


def mean_over_reference(images: list[np.ndarray], truth: np.ndarray, chosen: np.ndarray) -> float:
    """Mean luminance of the ``chosen`` pixels of all ``images`` over that of ``truth``; 1 of no pixels."""
    if not chosen.any():
        return 1.0
    ours = np.mean([luminance(image[chosen]).mean(dtype=np.float64) for image in images])
    return float(ours / luminance(truth[chosen]).mean(dtype=np.float64))
