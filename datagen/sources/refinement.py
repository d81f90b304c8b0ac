"""Fit surfels of a synthetic scene to its true G-buffers, and measure their errors.

Surfels made straight from G-buffers blur what is smaller than they are and overhang silhouettes by a pixel.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

import numpy as np

from datagen.clock import stage
from datagen.dataset.records import Figures, Refinement
from tron.captures import View
from tron.gaussians.scene import GaussianScene
from tron.reconstruction.geometry.losses import MATERIALS, Weights
from tron.reconstruction.geometry.surfels import LearntSurfels
from tron.reconstruction.geometry.training import Plan, Stage
from tron.reconstruction.scores import mean_figures, score_views
from tron.runtime import set_torch_threads
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

RATES = {
    "means": 0.01,
    "quats": 0.005,
    "log_scales": 0.01,
    "opacity_logits": 0.05,
    **dict.fromkeys(MATERIALS, 0.01),
}
"""Adam's rates, of the positions in surfel spacings: the demo's figures come of these and the weights."""
LAST_RATE = 0.1
"""Share of every rate that is left at the last step."""
WEIGHTS = Weights(normal=0.5, mask=0.5, base_color=1.0, roughness=0.2, metallic=0.2, ssim=0.0)
"""Weights of absolute errors. With structural similarity a step takes 1.7 times as long, and the surfels are
no better: -0.1 to 0.1 dB of frames of 512 x 512 (development scenes; dev/LOG.md, 2026-11-26)."""
WINDOW = 192
"""Side of the windows of larger views that steps compare, pixels: what a step takes beside its pixels is
small there, and more steps are worth more than whole views."""


@stage("refine")
def refine_surfels(
    surfels: GaussianScene,
    seen: Sequence[View],
    held_out: Sequence[View],
    steps: int,
    seed: int,
) -> tuple[GaussianScene, Refinement]:
    """Fit surfels to the views ``seen``, and judge them by ``held_out``; one view is read at a time.

    Args:
        surfels: as made from ``seen``. steps: of the optimisation. seed: of the order of views.
    """
    # The loss is small beside the tracing, and sums repeat bit by bit with one thread alone.
    set_torch_threads(1)
    started = time.perf_counter()
    refined = _fitted(surfels, seen, steps, seed)
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
    """Measure surfels against true G-buffers of views, read one at a time."""
    means = mean_figures(score_views(tracer, views))
    errors = [
        np.abs(tracer.gbuffer(view.camera).numpy()["opacity"] - view.read("mask")).mean() for view in views
    ]
    return Figures(
        base_color_psnr=round(means["base_color_psnr"], 4),
        normal_mae_deg=round(means["normal_mae_deg"], 4),
        silhouette_error=round(float(np.mean(errors)), 6),
    )


def _fitted(scene: GaussianScene, views: Sequence[View], steps: int, seed: int) -> GaussianScene:
    """Optimise the scene by the reconstruction's optimiser, on all maps of the views at once.

    Surfels made straight from G-buffers blur what is smaller than they are and overhang silhouettes by a
    pixel. Every parameter answers to the views, which have normal, base_color, roughness, metallic and mask.
    None is added: object ids, spacing and order of the surfels are kept.
    """
    if not steps:
        return scene
    rates = {**RATES, "means": RATES["means"] * scene.spacing}
    plan = Plan(
        name="refinement",
        steps=steps,
        weights=WEIGHTS,
        rates=rates,
        final_rates={name: LAST_RATE * rate for name, rate in rates.items()},
        window=WINDOW,
    )
    surfels = LearntSurfels.of_scene(scene, plan.rates)
    Stage(plan, views, surfels, scene.kernel_degree, seed).run()
    found = surfels.scene(scene.kernel_degree, scene.up)
    found.object_id, found.spacing = scene.object_id, scene.spacing
    return found.validate()
