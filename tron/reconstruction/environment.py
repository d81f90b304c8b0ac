"""The light of a capture: an environment map from irradiance priors and photos (paper, Algorithm 2).

Stage 3a (:mod:`tron.reconstruction.environment_refinement`) fits a cubemap to the priors' irradiance, stage
3b (:mod:`tron.reconstruction.light_scale`) one scale to the photos; the scene is frozen in both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from typing import Any

import mitsuba as mi
import numpy as np

from tron.captures import Capture
from tron.errors import TronError
from tron.gaussians import GaussianScene
from tron.reconstruction.environment_refinement import Estimator, refine
from tron.reconstruction.light_scale import LightScale, choose_photos, fit_scale
from tron.reconstruction.surface_points import SurfacePoints
from tron.shading.cubemap import CubemapLight
from tron.shading.environment import EnvironmentMap
from tron.shading.guidance import Lighting, ViewTracer
from tron.shading.split_sum import CUBEMAP_RESOLUTION
from tron.tracing import SurfelTracer

Track = Callable[[Iterable, str], Iterable]


@dataclass(frozen=True)
class FitSettings:
    """How an environment is fitted. The defaults take about half a minute on two CPU cores for a small scene;
    ``FitSettings.paper()`` wants a GPU.

    Attributes:
        resolution: texels along a face edge of the cubemap.
        steps: updates of the cubemap.
        rays: shadow rays a point, even.
        pixels: surface points a step, all of one view.
        learning_rate, final_learning_rate: Adam's steps in log radiance, which fall exponentially.
        estimator: "ratio", or "plain", the paper's, which needs far more rays (see stage 3a).
        coarsest: texels along a face edge of the coarsest level that log radiance is a sum of, at least 2;
            ``resolution`` or more fits each texel by itself, which gives the same irradiance and a noisy map.
        points_per_view: most surface points kept of a view.
        scale_steps: updates of the scale; 0 leaves it at 1.
        scale_learning_rate: first step in log sigma.
        scale_views, scale_pixels: at most so many photos, reduced to at most so many pixels each.
        scale_rays: shadow rays a pixel of those, even.
        split_sum_resolution: see :class:`tron.shading.SplitSum`.
        seed: root of every random number.

    Raises:
        TronError: a number outside its range.
    """

    resolution: int = 64
    steps: int = 1000
    rays: int = 8
    pixels: int = 1024
    learning_rate: float = 0.1
    final_learning_rate: float = 0.01
    estimator: Estimator = "ratio"
    coarsest: int = 4
    points_per_view: int = 1 << 16
    scale_steps: int = 200
    scale_learning_rate: float = 0.1
    scale_views: int = 8
    scale_pixels: int = 1 << 14
    scale_rays: int = 16
    split_sum_resolution: int = CUBEMAP_RESOLUTION
    seed: int = 0

    def __post_init__(self) -> None:
        least = {"resolution": 2, "coarsest": 2, "scale_steps": 0, "seed": None, "rays": 2, "scale_rays": 2}
        for field in fields(self):
            value, low = getattr(self, field.name), least.get(field.name, 1)
            if field.type == "int" and low is not None and (value != int(value) or value < low):
                raise TronError(f"{field.name} is {value}", mend=f"give a whole number of at least {low}")
            if field.type == "float" and not (np.isfinite(value) and value > 0):
                raise TronError(f"{field.name} is {value}", mend="give a positive number")
        for name in ("rays", "scale_rays"):
            if getattr(self, name) % 2:
                raise TronError(f"{name} is {getattr(self, name)}", mend="give an even number of shadow rays")
        if self.estimator not in ("ratio", "plain"):
            raise TronError(f"estimator is {self.estimator!r}", mend="use ratio or plain")

    @classmethod
    def paper(cls, **changes: Any) -> FitSettings:
        """The paper's size: 512 texels a face edge, 4000 steps; the other numbers are ours, it names none."""
        large = {"resolution": 512, "steps": 4000, "rays": 64, "pixels": 1 << 14, "scale_rays": 64}
        return cls(**{**large, "scale_pixels": 1 << 18, **changes})


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
        track: wraps long loops as ``track(items, label)``, such as :func:`tron.apps.progress.track`.

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
        tracer,
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
            rays=settings.scale_rays,
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
