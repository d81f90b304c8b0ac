"""The light of a capture: an environment map from irradiance priors and photos (paper, Algorithm 2).

Stage 3a (:func:`fit_cubemap`) fits a cubemap to the priors' irradiance, stage
3b (:func:`fit_scale`) one scale to the photos; the scene is frozen in both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.color import agx
from tron.errors import TronError
from tron.gaussians import GaussianScene
from tron.reconstruction.geometry.losses import photometric_loss
from tron.reconstruction.light.surface_points import PointBatch, SurfacePoints, surface_mask
from tron.reconstruction.light.surfel_colors import reduced
from tron.reconstruction.progress import Track, untracked
from tron.reconstruction.settings import FitSettings
from tron.runtime import aligned
from tron.seeds import generator, integer
from tron.shading.direct.irradiance import ORIGIN_OFFSET, Light, Occluder, RayPlan, shadow_ray, visible_share
from tron.shading.environments.cubemap import CubemapLight, seamless, texel_directions
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.environments.prefilter import unoccluded_irradiance
from tron.shading.guidance import Lighting, ViewTracer, render_guidance
from tron.tracing import GBuffer, SurfelTracer
from tron.tracing.hierarchy.transmittance import Fans

POINTS_PER_VIEW = 1 << 16
"""Most surface points of a view: 64 steps' worth of the default, 256 x 256 pixels."""
DARKEST = 1e-4
"""The first light is at least this bright, relative to its brightest channel: a logarithm needs light."""
RATE_POWER = 1.0
"""Learning rates fall with a level's resolution to this power; at 0.5 single texels still show as noise."""
_PHOTOS = 8  # at most, that the scale is fitted to
LEARNING_RATE = 0.1
"""Adam's first rate, in log sigma: it falls to a hundredth, so 200 steps reach factors of exp(4.3) = 70."""


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
    points = SurfacePoints(tracer, views, POINTS_PER_VIEW, settings.seed, track)
    cubemap = fit_cubemap(tracer.sided(settings.two_sided), points, settings, track)
    environment = CubemapLight(
        mi.Float(aligned(cubemap.texels.ravel())), settings.resolution
    ).to_environment()
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
    """Stage 3a: a cubemap such that the shadowed irradiance it gives the frozen scene is that of a prior.

    It begins with the constant whose unshadowed irradiance is the prior's mean. The parameter is the log
    of radiance, so light is positive and suns are within reach; it is a sum of levels (:class:`LogPyramid`).
    Each step takes one view, draws rays by multiple importance sampling from the cubemap as it stands, traces
    their visibility and moves the texels they hit along the gradient of the mean absolute error (paper,
    Algorithm 2). With a new light comes a new density to draw from.

    The "plain" estimator, the paper's, sums what the rays bring. Its noise is shared by the sign of the error
    and by the gradient, so the two correlate and the fit is biased, however many the steps. The "ratio"
    estimator, the default, takes from the rays only the share that is visible, and the unshadowed irradiance
    without noise from the texels, as the guidance buffers do. Measured on a sphere over a plane, relative
    error of irradiance over all normals: a studio of soft lights 10 % plain and 0.8 % by the ratio at 16
    rays, 2 % and 0.6 % at 64 and 32; a sun of six degrees 14 % and 1.6 % at 16 rays.

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


class LogPyramid:
    """Log radiance as a sum of cubemaps, each twice as fine as the one before: coarse patches move first.

    Irradiance hardly depends on single texels, and Adam gives each of them steps of the same size whatever
    its gradient, so texels fitted one by one end as noise. In a sum of levels every texel of a coarse level
    moves a whole patch of the sphere, and finer levels, whose steps are smaller, add what coarse ones cannot
    show. Every light can still be represented: this is a preconditioner, not a regulariser.

    Args:
        radiance: (6, R, R, 3) positive, linear: the finest level starts with all of it, the others with zero.
        coarsest: texels along a face edge of the coarsest level, at least 2; levels double up to R / 2, then
            R itself follows. R or more: the finest level alone, texels fitted one by one.

    Attributes:
        levels: names and first values of the parameters, 18 r^2 numbers each.
        finest: name of the level of resolution R.
    """

    def __init__(self, radiance: np.ndarray, coarsest: int) -> None:
        self.resolution = radiance.shape[1]
        self.finest = f"level_{self.resolution}"
        self._resolutions: dict[str, int] = {}
        resolution = coarsest
        while 2 * resolution <= self.resolution:
            self._resolutions[f"level_{resolution}"] = resolution
            resolution *= 2
        self._resolutions[self.finest] = self.resolution
        self._directions = texel_directions(self.resolution)
        dr.eval(self._directions)
        self.levels = {name: dr.zeros(mi.Float, 18 * r**2) for name, r in self._resolutions.items()}
        self.levels[self.finest] = mi.Float(
            aligned(np.log(radiance.astype(np.float64)).astype(np.float32).ravel())
        )

    def rate(self, name: str) -> float:
        """Factor of a level's learning rate: 1 for the coarsest."""
        coarsest = min(self._resolutions.values())
        return (coarsest / self._resolutions[name]) ** RATE_POWER

    def compose(self, levels: Mapping[str, mi.Float]) -> mi.Float:
        """Log radiance r, g, b of the finest texels: the bilinear sum of all levels, differentiable."""
        total = levels[self.finest]
        for name, resolution in self._resolutions.items():
            if name != self.finest:
                total = total + dr.ravel(seamless(levels[name], resolution, self._directions))
        return total


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
    chosen = np.sort(draw.permutation(len(views))[:_PHOTOS])
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
    """Stage 3b: the one factor by which a fitted environment must be multiplied to explain the photos.

    With geometry, materials and the environment frozen, a view's radiance (shadowed diffuse plus split-sum
    specular, the "shadowed" guidance buffer) is proportional to the factor, because split-sum and irradiance
    are linear in the light. So each view is rendered once, and a step compares AgX(exposure x sigma x
    radiance) with the photo as stored. Exposure and sigma appear as a product only: the exposure stays what
    the capture says, 1 where it says nothing, and sigma takes up the rest. It is its logarithm that is
    fitted.

    Fit the factor by Adam; the learning rate falls to a hundredth, exponentially.

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
    optimizer = torch.optim.Adam([log_sigma], lr=LEARNING_RATE)
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


@dataclass
class Transport:
    """Shadow rays with their visibility, pixel-major: lane = pixel x ``per_pixel`` + ray.

    The rays of :mod:`tron.shading.direct.irradiance`, the same estimator and the same weights, are traced
    once and kept. Irradiance / pi is then a weighted sum of looked-up radiance, linear in the light:
    gradients reach its texels, and stop at visibility, directions and densities. Memory grows with pixels x
    rays.

    Attributes:
        direction: unit, world.
        weight: what a ray's radiance is multiplied by on its way into unshadowed irradiance / pi.
        visibility: transmittance of what stands in the way.
        per_pixel: rays of a pixel.
    """

    direction: mi.Vector3f
    weight: mi.Float
    visibility: mi.Float
    per_pixel: int

    @classmethod
    def trace(
        cls,
        tracer: Occluder,
        gbuffer: GBuffer,
        light: Light,
        spp: int,
        seed: int,
    ) -> Transport:
        """Draw and trace rays as :mod:`tron.shading.direct.irradiance` does; `light` only chooses directions.

        Args:
            tracer, gbuffer, spp, seed: as there; pixels of opacity 0 get rays of weight 0.
            light: what half the rays are drawn from.

        Raises:
            TronError: ``spp`` is odd or not positive, or there are more rays than 32-bit indices address.
        """
        plan = RayPlan.make(spp, seed, gbuffer.width)
        pixels = dr.width(gbuffer.opacity)
        if pixels * spp >= 1 << 32:
            raise TronError(f"{pixels} pixels of {spp} rays are too many at once", mend="take fewer pixels")
        lane = dr.arange(mi.UInt32, pixels * spp)
        rays = dr.opaque(mi.UInt32, plan.rays)
        pixel, ray = lane // rays, lane % rays
        in_rows = dr.gather(mi.UInt32, gbuffer.pixel, pixel)

        def spread(value: mi.Point3f) -> mi.Point3f:
            return type(value)(*[dr.gather(mi.Float, channel, pixel) for channel in value])

        with dr.suspend_grad():
            normal = mi.Normal3f(spread(gbuffer.normal))
            surface = dr.gather(mi.Float, gbuffer.opacity, pixel) > 0
            direction, weight = shadow_ray(light, mi.Frame3f(normal), plan, in_rows, ray)
            counts = surface & (weight > 0)
            offset = dr.opaque(mi.Float, ORIGIN_OFFSET * tracer.scene.spacing)
            origin = spread(gbuffer.position) + normal * offset
            weight = dr.select(counts, weight, 0) / mi.Float(plan.count)
            dr.eval(direction, weight, origin, counts)
        (visibility,) = tracer.transmittances(Fans(origin, [direction], [counts], mi.Vector3f(normal)))
        dr.eval(visibility)
        return cls(direction, weight, visibility, spp)

    def irradiance(self, light: Light) -> tuple[mi.Color3f, mi.Color3f]:
        """Shadowed and unshadowed irradiance / pi of each pixel, linear in ``light`` and differentiable."""
        found = light.radiance(self.direction) * self.weight

        def of_pixels(value: mi.Color3f) -> mi.Color3f:
            return mi.Color3f(*[dr.block_sum(channel, self.per_pixel) for channel in value])

        return of_pixels(found * self.visibility), of_pixels(found)
