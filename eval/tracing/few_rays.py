"""Irradiance of a preview's few rays, filtered and not: is a shadow as dark as it should be, and how noisy?

A biased estimator can have little noise, and the filter hides what noise there is: so beside the error stands
the mean over the pixels in shadow, as a share of the reference's there.
"""

from __future__ import annotations

import numpy as np

from eval.peers.contenders import Contenders
from eval.peers.scene import camera
from eval.relighting.shadows import shadow_pixels
from eval.tracing.irradiance import REFERENCE_SEED, relative_rmse
from eval.tracing.lights import LIGHTS
from eval.tracing.measured import FewRays, LitImages
from tron.color import luminance
from tron.shading import Estimation, Lighting, render_guidance

RAYS = (2, 4, 8)
TRIALS = 4
REFERENCE_SPP = 1024
"""Rays a pixel of the reference at most: where it is compared, 4 trials of 8 rays are 30 times as noisy."""


def measure_few_rays(contenders: Contenders, size: int, light: str, reference_spp: int, seed: int) -> FewRays:
    """Render ``size`` x ``size`` pixels with few rays, ``TRIALS`` times each way, and hold them to many."""
    environment = LIGHTS[light]()
    view, lighting, tracer = camera(size), Lighting(environment), contenders.tracer
    spp = min(reference_spp, REFERENCE_SPP)
    truth = render_guidance(tracer, view, lighting, Estimation(rays=spp), REFERENCE_SEED)
    surface = truth.mask > 0
    shadowed = shadow_pixels(truth.irradiance, truth.irradiance, truth.unshadowed, surface).shadowed
    plane = float(luminance(environment.unoccluded_upward()))
    mean, rmse, images = {}, {}, {"reference": truth.irradiance}
    for rays in RAYS:
        for filtered in (False, True):
            way = f"{rays}.filtered" if filtered else f"{rays}"
            how = Estimation(rays=rays, filtered=filtered)
            found = [render_guidance(tracer, view, lighting, how, seed + k).irradiance for k in range(TRIALS)]
            mean[way] = mean_over_reference(found, truth.irradiance, shadowed)
            rmse[way] = relative_rmse(found, truth.irradiance, surface, plane)
            images[way] = found[0]
    return FewRays(LitImages(light, environment.exposure(), images), TRIALS, mean, rmse)


def mean_over_reference(images: list[np.ndarray], truth: np.ndarray, chosen: np.ndarray) -> float:
    """Mean luminance of the ``chosen`` pixels of all ``images`` over that of ``truth``; 1 of no pixels."""
    if not chosen.any():
        return 1.0
    ours = np.mean([luminance(image[chosen]).mean(dtype=np.float64) for image in images])
    return float(ours / luminance(truth[chosen]).mean(dtype=np.float64))
