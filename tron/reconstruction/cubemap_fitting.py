"""Stage 3a: a cubemap such that the shadowed irradiance it gives the frozen scene is that of a prior.

The parameter is the logarithm of radiance, so light is positive and suns are within reach; it is a sum of
levels (:mod:`tron.reconstruction.log_pyramid`). Each step takes one view, draws rays by multiple importance
sampling from the cubemap as it stands, traces their visibility and moves the texels they hit along the
gradient of the mean absolute error (paper, Algorithm 2). With a new light comes a new density to draw from.

The "plain" estimator, the paper's, sums what the rays bring. Its noise is shared by the sign of the error
and by the gradient, so the two correlate and the fit is biased, however many the steps. The "ratio"
estimator, the default, takes from the rays only the share that is visible, and the unshadowed irradiance
without noise from the texels, as the guidance buffers do. Measured on a sphere over a plane, relative error
of irradiance over all normals: a studio of soft lights 10 % plain and 0.8 % by the ratio at 16 rays, 2 %
and 0.6 % at 64 and 32; a sun of six degrees 14 % and 1.6 % at 16 rays.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.errors import TronError
from tron.priors import Track, untracked
from tron.reconstruction.log_pyramid import LogPyramid
from tron.reconstruction.settings import FitSettings
from tron.reconstruction.surface_points import PointBatch, SurfacePoints
from tron.seeds import generator, integer
from tron.shading.cubemap import CubemapLight
from tron.shading.irradiance import Occluder, visible_share
from tron.shading.prefilter import unoccluded_irradiance
from tron.shading.transport import Transport

DARKEST = 1e-4
"""The first light is at least this bright, relative to its brightest channel: a logarithm needs light."""


@dataclass
class CubemapFit:
    """A fitted cubemap.

    Attributes:
        texels: (6, R, R, 3) float32 linear radiance.
        has_gradient: (6, R, R) bool, texels with a gradient of their own in any step; the others have what
            coarser levels give them, and without such levels their initial radiance.
        loss: (steps,) float64, the mean absolute error of each step's view, in the unit of the prior.
    """

    texels: np.ndarray
    has_gradient: np.ndarray
    loss: np.ndarray


def fit_cubemap(
    tracer: Occluder, points: SurfacePoints, settings: FitSettings, track: Track = untracked
) -> CubemapFit:
    """Fit the cubemap, beginning with the constant whose unshadowed irradiance is the prior's mean.

    Args:
        tracer: what blocks light.
        points: surface points with the irradiance / pi that is wanted there.
        settings: sizes, rates and seed; Adam's rate falls exponentially.
        track: wraps the steps, to show progress.

    Raises:
        TronError: the loss is not finite; the message names the step.
    """
    resolution, steps, seed = settings.resolution, settings.steps, settings.seed
    mean = np.maximum(points.mean_target, DARKEST * points.mean_target.max())
    pyramid = LogPyramid(np.broadcast_to(mean, (6, resolution, resolution, 3)), settings.coarsest)
    optimizer = mi.ad.Adam(settings.learning_rate, pyramid.levels, epsilon=1e-15)
    decay = (settings.final_learning_rate / settings.learning_rate) ** (1 / max(1, steps - 1))
    draw = generator(seed, "environment", "steps")
    loss_curve = np.empty(steps)
    has_gradient = dr.zeros(mi.Bool, 18 * resolution**2)
    for step in track(range(steps), "Environment"):
        view = int(draw.integers(points.views))
        batch = points.batch(view, settings.pixels, draw)
        log_radiance = pyramid.compose(optimizer)
        light = CubemapLight(dr.exp(log_radiance), resolution)
        ray_seed = integer(seed, "environment", "rays", step)
        transport = Transport.trace(tracer, batch, light, settings.rays, ray_seed)
        error = dr.abs(_estimate(transport, light, batch, settings.estimator) - batch.target)
        loss = dr.mean((error.x + error.y + error.z) / 3)
        dr.backward(loss)
        has_gradient |= dr.grad(optimizer[pyramid.finest]) != 0
        dr.schedule(has_gradient)
        for name in pyramid.levels:
            rate = settings.learning_rate * decay**step * pyramid.rate(name)
            optimizer.set_learning_rate({name: dr.opaque(mi.Float, rate)})
        optimizer.step()
        loss_curve[step] = float(loss[0])
        if not np.isfinite(loss_curve[step]):
            raise TronError(
                f"the loss of the environment is {loss_curve[step]} at step {step}",
                mend="lower the learning rate, or look at the irradiance prior",
            )
    texels = np.array(dr.exp(pyramid.compose(optimizer))).reshape(6, resolution, resolution, 3)
    own = np.array(has_gradient).reshape(6, resolution, resolution, 3).any(-1)
    return CubemapFit(texels, own, loss_curve)


def _estimate(transport: Transport, light: CubemapLight, batch: PointBatch, estimator: str) -> mi.Color3f:
    shadowed, unshadowed = transport.irradiance(light)
    if estimator == "plain":
        return shadowed
    return unoccluded_irradiance(light, batch.normal) * visible_share(shadowed, unshadowed)
