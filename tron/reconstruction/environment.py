"""The light of a capture: an environment map from irradiance priors and photos (paper, Algorithm 2).

Stage 3a (:mod:`tron.reconstruction.cubemap_fitting`) fits a cubemap to the priors' irradiance, stage
3b (:mod:`tron.reconstruction.light_scale`) one scale to the photos; the scene is frozen in both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from tron.captures import Capture
from tron.errors import TronError
from tron.estimation import Estimation
from tron.gaussians import GaussianScene
from tron.reconstruction.cubemap_fitting import refine
from tron.reconstruction.light_scale import LightScale, choose_photos, fit_scale
from tron.reconstruction.settings import FitSettings
from tron.reconstruction.surface_points import SurfacePoints
from tron.shading.cubemap import CubemapLight
from tron.shading.environment import EnvironmentMap
from tron.shading.guidance import Lighting, ViewTracer
from tron.tracing import SurfelTracer

Track = Callable[[Iterable, str], Iterable]


@dataclass(frozen=True, eq=False)
class EnvironmentFit:
    """What was found.

    Attributes:
        environment: the light, sigma included, as a lat-long map.
        sigma: the scale of stage 3b, already in ``environment``; 1 if it was not fitted.
        texels: (6, R, R, 3) float32 cubemap of stage 3a, sigma not included.
        seen: (6, R, R) bool, texels with a gradient of their own in any step; the others have what coarser
            levels give them, and without such levels the initial constant radiance.
        irradiance_loss: (steps,) mean absolute error of stage 3a, in the unit of the priors.
        scale_loss, scale_curve: (scale_steps,) photometric loss, and sigma, in stage 3b.
    """

    environment: EnvironmentMap
    sigma: float
    texels: np.ndarray
    seen: np.ndarray
    irradiance_loss: np.ndarray
    scale_loss: np.ndarray
    scale_curve: np.ndarray


def fit_environment(
    capture: Capture,
    scene: GaussianScene | ViewTracer,
    settings: FitSettings | None = None,
    track: Track | None = None,
) -> EnvironmentFit:
    """Find the environment map under which the scene looks as the capture's training views do.

    Pixels count where the scene is opaque, the view's mask (if any) holds and its sky mask does not. Results
    repeat bit by bit with one Dr.Jit and one torch thread; with several, gradients are summed in any order.

    Args:
        capture: its training views with an irradiance map feed stage 3a, all training views stage 3b.
        scene: frozen surfels, or a tracer that the caller has already.
        settings: sizes, rates, seed.
        track: wraps long loops as ``track(items, label)``, such as :func:`tron.cli.progress.track`.

    Raises:
        TronError: no training view has an irradiance map, maps are wrong, nothing of the scene is visible, or
            the loss is not finite.
    """
    settings = settings or FitSettings()
    track = track or (lambda items, _: items)
    views = [view for view in capture.train_views if view.has("irradiance")]
    if not views:
        raise TronError(
            "no training view has an irradiance map",
            mend="run an irradiance prior first, or add the maps of one to the capture",
        )
    tracer = _tracer(scene)
    # Photos are read before the long work, so that a bad file is told at once.
    photos = []
    if settings.scale_steps:
        photos = choose_photos(
            capture.train_views,
            settings.scale_views,
            settings.scale_pixels,
            capture.exposure,
            settings.seed,
        )
    points = SurfacePoints(tracer, views, settings.points_per_view, settings.seed, track)
    refined = refine(
        tracer.sided(settings.two_sided),
        points,
        resolution=settings.resolution,
        steps=settings.steps,
        rays=settings.rays,
        pixels=settings.pixels,
        learning_rate=settings.learning_rate,
        final_learning_rate=settings.final_learning_rate,
        estimator=settings.estimator,
        coarsest=settings.coarsest,
        seed=settings.seed,
        track=track,
    )
    light = CubemapLight(mi.Float(refined.texels.ravel()), settings.resolution)
    environment = light.to_environment()
    scale = LightScale(1.0, np.zeros(0), np.zeros(0))
    if photos:
        scale = fit_scale(
            tracer,
            photos,
            Lighting(environment, settings.split_sum_resolution),
            exposure=capture.exposure,
            steps=settings.scale_steps,
            estimation=Estimation(
                rays=settings.scale_rays, estimator=settings.estimator, two_sided=settings.two_sided
            ),
            learning_rate=settings.scale_learning_rate,
            seed=settings.seed,
            track=track,
        )
    return EnvironmentFit(
        environment=EnvironmentMap(environment.image * np.float32(scale.sigma)),
        sigma=scale.sigma,
        texels=refined.texels,
        seen=refined.seen,
        irradiance_loss=refined.loss,
        scale_loss=scale.loss,
        scale_curve=scale.curve,
    )


def _tracer(scene: GaussianScene | ViewTracer) -> ViewTracer:
    if not isinstance(scene, GaussianScene):
        return scene
    if not scene.oriented:
        raise TronError(
            "the scene's surfels have no orientation, so no camera and no light knows their front",
            mend="reconstruct it with normals",
        )
    return SurfelTracer(scene.validate())
