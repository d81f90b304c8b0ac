"""Base color of reconstructed surfels at the truth's scale.

A joint fit of light and materials leaves one factor a channel open: twice the reflectance under half the
light is the same photo. Under another light it is not, and nobody could mend it. Data that relighting is
learnt from or judged by takes the factor from the truth, as evaluations of inverse rendering do (NeRFactor,
TensoIR).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from tron.cameras import Camera
from tron.gaussians.scene import GaussianScene
from tron.metrics import albedo_scale
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

OPAQUE = 0.99
"""Opacity above which a pixel shows surfels alone."""


def at_true_scale(
    surfels: GaussianScene, truth: Iterable[tuple[Camera, np.ndarray, np.ndarray]]
) -> tuple[GaussianScene, np.ndarray]:
    """The surfels with their base color scaled to the truth, and the factors (3,).

    The factors are the median ratios over the pixels of all views where both show a surface; they are 1 where
    there is no such pixel. Base color stays in [0, 1]. The log says the factors.

    Args:
        surfels: of a reconstruction.
        truth: views: camera, true base color (H, W, 3) linear, mask (H, W) of the pixels that have one.
    """
    tracer = SurfelTracer(surfels)
    found, wanted = [], []
    for camera, base_color, mask in truth:
        buffers = tracer.gbuffer(camera).numpy()
        both = (mask > 0) & (buffers["opacity"] > OPAQUE)
        found.append(buffers["base_color"][both])
        wanted.append(base_color[both])
    if not sum(map(len, found)):
        log.warning("no view shows the surfels where the truth has a surface: base color is left as it is")
        return surfels, np.ones(3)
    factors = albedo_scale(np.concatenate(found), np.concatenate(wanted), method="median_ratio")
    log.info("base color scaled by %.2f, %.2f, %.2f", *factors)
    scaled = np.clip(surfels.base_color * factors.astype(np.float32), 0, 1)
    return replace(surfels, base_color=scaled), factors
