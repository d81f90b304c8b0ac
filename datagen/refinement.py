"""A scene's surfels fitted to its true G-buffers, and what that gained on views that were held out."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

import numpy as np

from datagen.clock import stage
from datagen.plan import Figures, Refinement
from tron.captures import View
from tron.gaussians.scene import GaussianScene
from tron.reconstruction.evaluation import mean_figures, score_views
from tron.reconstruction.gbuffer_fitting import RefinementSettings, refine
from tron.runtime import set_torch_threads
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)


@stage("refine")
def refine_surfels(
    surfels: GaussianScene,
    seen: Sequence[View],
    held_out: Sequence[View],
    steps: int,
    seed: int,
    device: str,
) -> tuple[GaussianScene, Refinement]:
    """Fit surfels to what ``seen`` shows of them, and judge them by ``held_out``; one view is read at a time.

    Args:
        surfels: as made from ``seen``. steps: of the optimisation. seed: of the order of views.
        device: torch's, that of the active Mitsuba variant.
    """
    # The loss is small beside the tracing, and sums repeat bit by bit with one thread alone.
    set_torch_threads(1)
    started = time.perf_counter()
    settings = RefinementSettings(steps=steps)
    refined = refine(surfels, seen, settings, seed, device)
    seconds = time.perf_counter() - started
    before, after = (figures_of(SurfelTracer(scene), held_out) for scene in (surfels, refined))
    found = Refinement(steps=steps, before=before, after=after)
    log.info(
        "surfels refined in %.1f s: base color %.1f -> %.1f dB, normals %.2f -> %.2f degrees",
        seconds, found.before.base_color_psnr, found.after.base_color_psnr,
        found.before.normal_mae_deg, found.after.normal_mae_deg,
    )  # fmt: skip
    return refined, found


def figures_of(tracer: SurfelTracer, views: Sequence[View]) -> Figures:
    """Surfels against the true G-buffers of views, one read at a time."""
    means = mean_figures(score_views(tracer, views))
    errors = [
        np.abs(tracer.gbuffer(view.camera).numpy()["opacity"] - view.read("mask")).mean() for view in views
    ]
    return Figures(
        base_color_psnr=round(means["base_color_psnr"], 4),
        normal_mae_deg=round(means["normal_mae_deg"], 4),
        silhouette_error=round(float(np.mean(errors)), 6),
    )
