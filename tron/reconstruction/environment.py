"""The light of a capture: an environment map from irradiance priors and photos (paper, Algorithm 2).

Stage 3a (:mod:`tron.reconstruction.cubemap_fitting`) fits a cubemap to the priors' irradiance, stage
3b (:mod:`tron.reconstruction.light_scale`) one scale to the photos; the scene is frozen in both.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from tron.captures import Capture
from tron.errors import TronError
from tron.gaussians import GaussianScene
from tron.priors import Track, untracked
from tron.reconstruction.cubemap_fitting import CubemapFit, fit_cubemap
from tron.reconstruction.light_scale import LightScale, choose_photos, fit_scale
from tron.reconstruction.settings import FitSettings
from tron.reconstruction.surface_points import SurfacePoints
from tron.shading.cubemap import CubemapLight
from tron.shading.environment import EnvironmentMap
from tron.shading.guidance import Lighting, ViewTracer
from tron.tracing import SurfelTracer


@dataclass(frozen=True, eq=False)
class EnvironmentFit:
    """Light of a capture, and how it was found.

    Attributes:
        environment: the light, as a lat-long map, the scale of stage 3b included.
        cubemap: of stage 3a, the scale not included.
        scale: of stage 3b; 1 if it was not fitted.
    """

    environment: EnvironmentMap
    cubemap: CubemapFit
    scale: LightScale


def fit_environment(
    capture: Capture,
    scene: GaussianScene | ViewTracer,
    settings: FitSettings | None = None,
    track: Track = untracked,
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
    views = [view for view in capture.train_views if view.has("irradiance")]
    if not views:
        raise TronError(
            "no training view has an irradiance map",
            mend="run an irradiance prior first, or add the maps of one to the capture",
        )
    tracer = _tracer(scene)
    # Photos are read before the long work, so that a bad file is told at once.
    photos = choose_photos(capture.train_views, settings, capture.exposure) if settings.scale_steps else []
    points = SurfacePoints(tracer, views, settings.points_per_view, settings.seed, track)
    cubemap = fit_cubemap(tracer.sided(settings.two_sided), points, settings, track)
    environment = CubemapLight(mi.Float(cubemap.texels.ravel()), settings.resolution).to_environment()
    scale = LightScale(1.0, np.zeros(0), np.zeros(0))
    if photos:
        lighting = Lighting(environment, settings.split_sum_resolution)
        scale = fit_scale(tracer, photos, lighting, settings, capture.exposure, track)
    return EnvironmentFit(EnvironmentMap(environment.image * np.float32(scale.sigma)), cubemap, scale)


def _tracer(scene: GaussianScene | ViewTracer) -> ViewTracer:
    if not isinstance(scene, GaussianScene):
        return scene
    if not scene.oriented:
        raise TronError(
            "the scene's surfels have no orientation, so no camera and no light knows their front",
            mend="reconstruct it with normals",
        )
    return SurfelTracer(scene.validate())
