"""A scene's surfels fitted to its true G-buffers, and what that gained on views that were held out."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

import numpy as np

from datagen.clock import stage
from datagen.plan import Figures, Refinement
from tron.captures import View
from tron.color import linear_to_srgb
from tron.gaussians.initialize import GBufferView
from tron.gaussians.scene import GaussianScene
from tron.reconstruction.evaluation import mean_figures, score_views
from tron.reconstruction.gbuffer_fitting import RefinementSettings, refine
from tron.runtime import set_torch_threads
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)


@stage("refine")
def refine_surfels(
    surfels: GaussianScene,
    seen: Sequence[GBufferView],
    held_out: Sequence[GBufferView],
    steps: int,
    seed: int,
    device: str,
) -> tuple[GaussianScene, Refinement]:
    """Fit surfels to what ``seen`` shows of them, and judge them by ``held_out``.

    Args:
        surfels: as made from ``seen``. steps: of the optimisation. seed: of the order of views.
        device: torch's, that of the active Mitsuba variant.
    """
    # The loss is small beside the tracing, and sums repeat bit by bit with one thread alone.
    set_torch_threads(1)
    started = time.perf_counter()
    settings = RefinementSettings(steps=steps)
    refined = refine(surfels, [as_view(i, view) for i, view in enumerate(seen)], settings, seed, device)
    seconds = time.perf_counter() - started
    judges = [as_view(i, view) for i, view in enumerate(held_out)]
    found = Refinement(steps=steps, before=_figures(surfels, judges), after=_figures(refined, judges))
    log.info(
        "surfels refined in %.1f s: base color %.1f -> %.1f dB, normals %.2f -> %.2f degrees",
        seconds, found.before.base_color_psnr, found.after.base_color_psnr,
        found.before.normal_mae_deg, found.after.normal_mae_deg,
    )  # fmt: skip
    return refined, found


def as_view(number: int, seen: GBufferView) -> View:
    """A true G-buffer as what a reconstruction learns from; no light is on, so the picture is base color."""
    inside = seen.valid[..., None]
    base_color = np.where(inside, seen.base_color, 0)
    return View(
        name=f"{number:04d}",
        camera=seen.camera,
        image=linear_to_srgb(base_color),
        space="display",
        normal=np.where(inside, seen.normal, 0),
        base_color=base_color,
        roughness=np.where(seen.valid, seen.roughness, 0),
        metallic=np.where(seen.valid, seen.metallic, 0),
        mask=seen.valid.astype(np.float32),
    )


def _figures(surfels: GaussianScene, views: Sequence[View]) -> Figures:
    tracer = SurfelTracer(surfels)
    means = mean_figures(score_views(tracer, views))
    opacity = [tracer.gbuffer(view.camera).numpy()["opacity"] for view in views]
    error = np.mean([np.abs(o - view.read("mask")).mean() for o, view in zip(opacity, views)])
    return Figures(
        base_color_psnr=round(means["base_color_psnr"], 4),
        normal_mae_deg=round(means["normal_mae_deg"], 4),
        silhouette_error=round(float(error), 6),
    )
