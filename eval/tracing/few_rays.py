"""Irradiance of a preview's few rays, filtered and not: is a shadow as dark as it should be, and how noisy?

A biased estimator can have little noise, and the filter hides what noise there is: so beside the error stands
the mean over the pixels in shadow, as a share of the reference's there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from eval.peers.contenders import Contenders
from eval.peers.scene import camera
from eval.relighting.shadows import DirectLight, shadow_classes
from eval.results import Row
from eval.tracing.irradiance import REFERENCE_SEED, relative_rmse
from eval.tracing.lights import LIGHTS
from tron.color import luminance
from tron.shading import Estimation, Lighting, render_guidance

RAYS = (2, 4, 8)
TRIALS = 4
REFERENCE_SPP = 1024
"""Rays a pixel of the reference at most: where it is compared, 4 trials of 8 rays are 30 times as noisy."""

Way = tuple[int, bool]
"""Rays a pixel, and whether they are filtered."""


@dataclass(frozen=True)
class FewRays:
    """Irradiance under one light, by way.

    Attributes:
        mean: of the pixels in shadow, over the reference's.
        rmse: over all pixels with a surface, as a share of an upward plane's light.
        images: linear (H, W, 3), one trial of each way.
        reference: (H, W, 3) linear.
    """

    light: str
    mean: Mapping[Way, float]
    rmse: Mapping[Way, float]
    images: Mapping[Way, np.ndarray]
    reference: np.ndarray
    exposure: float


def measure_few_rays(contenders: Contenders, size: int, light: str, reference_spp: int, seed: int) -> FewRays:
    """Render ``size`` x ``size`` pixels with few rays, ``TRIALS`` times each way, and hold them to many."""
    environment = LIGHTS[light]()
    view, lighting, tracer = camera(size), Lighting(environment), contenders.tracer
    spp = min(reference_spp, REFERENCE_SPP)
    truth = render_guidance(tracer, view, lighting, Estimation(rays=spp), REFERENCE_SEED)
    surface = truth.mask > 0
    shadowed, _ = shadow_classes(DirectLight(truth.irradiance, truth.unshadowed), surface)
    plane = float(luminance(environment.unoccluded_upward()))
    mean, rmse, images = {}, {}, {}
    for way in [(rays, filtered) for rays in RAYS for filtered in (False, True)]:
        found = [
            render_guidance(
                tracer, view, lighting, Estimation(rays=way[0], filtered=way[1]), seed + k
            ).irradiance
            for k in range(TRIALS)
        ]
        mean[way] = mean_over_reference(found, truth.irradiance, shadowed)
        rmse[way] = relative_rmse(found, truth.irradiance, surface, plane)
        images[way] = found[0]
    return FewRays(light, mean, rmse, images, truth.irradiance, environment.exposure())


def mean_over_reference(images: list[np.ndarray], truth: np.ndarray, chosen: np.ndarray) -> float:
    """Mean luminance of the ``chosen`` pixels of all ``images`` over that of ``truth``; 1 of no pixels."""
    if not chosen.any():
        return 1.0
    ours = np.mean([luminance(image[chosen]).mean(dtype=np.float64) for image in images])
    return float(ours / luminance(truth[chosen]).mean(dtype=np.float64))


def few_rays_rows(measured: list[FewRays]) -> list[Row]:
    """Means and errors of every light and way, and the least and the greatest mean."""
    rows = []
    for found in measured:
        for figure, unit, values in (
            ("shadowed_mean_over_reference", "x", found.mean),
            ("few_rays_rmse", "fraction", found.rmse),
        ):
            for (rays, filtered), value in values.items():
                name = f"irradiance.{figure}.{found.light}.{rays}{'.filtered' if filtered else ''}"
                rows.append(Row(metric=name, value=value, unit=unit, n=TRIALS))
    means = [value for found in measured for value in found.mean.values()]
    for name, value in (("least", min(means)), ("greatest", max(means))):
        metric = f"irradiance.shadowed_mean_over_reference.{name}"
        rows.append(Row(metric=metric, value=value, unit="x", n=TRIALS * len(means)))
    return rows
