"""Stage 3b: the one factor by which a fitted environment must be multiplied to explain the photos.

With geometry, materials and the environment frozen, a view's radiance (shadowed diffuse plus split-sum
specular, the "shadowed" guidance buffer) is proportional to the factor, because split-sum and irradiance are
linear in the light. So each view is rendered once, and a step compares AgX(exposure x sigma x radiance) with
the photo as stored. Exposure and sigma appear as a product only: the exposure stays what the capture says,
1 where it says nothing, and sigma takes up the rest. It is its logarithm that is fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from tron.cameras import Camera
from tron.captures import View
from tron.color import agx
from tron.errors import TronError
from tron.priors import Track, untracked
from tron.reconstruction.losses import photometric_loss
from tron.reconstruction.settings import FitSettings
from tron.reconstruction.surface_points import surface_mask
from tron.seeds import generator, integer
from tron.shading.guidance import Lighting, ViewTracer, render_guidance


@dataclass
class Photo:
    """A view made small enough: its camera, what to compare with, and the view it comes from.

    Attributes:
        view: the original.
        camera: of the smaller image.
        shown: (H, W, 3) float32 display values.
        factor: how many pixels along a side became one.
    """

    view: View
    camera: Camera
    shown: np.ndarray
    factor: int


@dataclass
class LightScale:
    """A fitted factor and how it came about.

    Attributes:
        sigma: the factor.
        loss: (steps,) float64 photometric loss of each step's view.
        curve: (steps,) float64 sigma before each step.
    """

    sigma: float
    loss: np.ndarray
    curve: np.ndarray


def choose_photos(views: Sequence[View], settings: FitSettings, exposure: float) -> list[Photo]:
    """Read some views, drawn at random, reduced by averaging to at most ``scale_pixels`` pixels each.

    Linear images are exposed and tone-mapped by AgX, display images are taken as they are.
    """
    draw = generator(settings.seed, "environment", "photos")
    chosen = np.sort(draw.permutation(len(views))[: settings.scale_views])
    photos = []
    for view in (views[i] for i in chosen):
        factor = max(1, int(np.ceil(np.sqrt(view.camera.width * view.camera.height / settings.scale_pixels))))
        shown = view.read()
        if view.space == "linear":
            shown = agx(exposure * shown)
        photos.append(Photo(view, reduced_camera(view.camera, factor), reduced(shown, factor), factor))
    return photos


def fit_scale(
    tracer: ViewTracer,
    photos: Sequence[Photo],
    lighting: Lighting,
    settings: FitSettings,
    exposure: float,
    track: Track = untracked,
) -> LightScale:
    """Fit the factor by Adam; the learning rate falls to a hundredth, exponentially.

    Args:
        tracer: the scene.
        photos: what to compare with.
        lighting: the environment of factor 1.
        settings: steps, each on one random photo; rays, first rate in log sigma, seed.
        exposure: of the capture.
        track: wraps the long loops, to show progress.

    Raises:
        TronError: no photo shows a surface of the scene, or the loss is not finite.
    """
    steps, seed = settings.scale_steps, settings.seed
    estimation = settings.estimation(settings.scale_rays)
    pairs = []
    for photo in track(photos, "Scale: views"):
        ray_seed = integer(seed, "environment", "scale", photo.view.name)
        guidance = render_guidance(tracer, photo.camera, lighting, estimation, ray_seed)
        counts = reduced(surface_mask_of(photo), photo.factor) > 0.5
        counts &= guidance.mask > 0.5
        if counts.any():
            pairs.append([torch.from_numpy(a) for a in (exposure * guidance.shadowed, photo.shown, counts)])
    if not pairs:
        raise TronError("no photo shows a surface of the scene", mend="check cameras and masks")
    log_sigma = torch.zeros((), requires_grad=True)
    optimizer = torch.optim.Adam([log_sigma], lr=settings.scale_learning_rate)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.01 ** (1 / steps))
    draw = generator(seed, "environment", "scale steps")
    loss_curve, curve = np.empty(steps), np.empty(steps)
    for step in track(range(steps), "Scale"):
        radiance, shown, counts = pairs[int(draw.integers(len(pairs)))]
        loss = photometric_loss(agx(log_sigma.exp() * radiance), shown, counts)
        optimizer.zero_grad()
        loss.backward()
        curve[step], loss_curve[step] = float(log_sigma.detach().exp()), float(loss.detach())
        if not np.isfinite(loss_curve[step]):
            raise TronError(f"the loss of the light's scale is {loss_curve[step]} at step {step}")
        optimizer.step()
        schedule.step()
    return LightScale(float(log_sigma.detach().exp()), loss_curve, curve)


def surface_mask_of(photo: Photo) -> np.ndarray:
    """(H, W) float32 of the original view: 1 where its masks leave a surface."""
    camera = photo.view.camera
    return surface_mask(photo.view, np.ones((camera.height, camera.width), np.float32)).astype(np.float32)


def reduced(image: np.ndarray, factor: int) -> np.ndarray:
    """Means of ``factor`` x ``factor`` pixels; what is left over at the right and the bottom is dropped."""
    if factor == 1:
        return image
    height, width = (n // factor for n in image.shape[:2])
    blocks = image[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
    return np.ascontiguousarray(blocks.mean((1, 3)).reshape(height, width, *image.shape[2:]))


def reduced_camera(camera: Camera, factor: int) -> Camera:
    """The camera of :func:`reduced` images."""
    return replace(
        camera,
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=camera.cx / factor,
        cy=camera.cy / factor,
        width=camera.width // factor,
        height=camera.height // factor,
    )
