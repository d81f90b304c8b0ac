"""Materials by inverse rendering: ``lit`` of the surfels, made to look as the photos do, in a known light.

    min over base color, roughness, metallic of
        mean over pixels of  |log (g_v lit + d) - log (photo + d)|
        + tie  mean over surfels of  (roughness - r0)^2 + (metallic - m0)^2
        + even mean over neighbours of like colour of the same differences between them

g_v is the photo's exposure, d a tenth of the mean photo, below which 8 bits and logarithms disagree. Shadow
rays of pixels and surfels and what surfels see of one another are traced once (``FixedRays``):
gradients reach all surfels through the light they send to one another, and visibility stands still.
Base color is free; r0 and m0 are what evidence over views said (:mod:`tron.reconstruction.lobes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import Field
from scipy.spatial import KDTree

from tron.aligned import aligned
from tron.captures import View
from tron.errors import TronError
from tron.estimation import Estimation
from tron.gaussians import GaussianScene
from tron.gaussians.fields import MATERIALS
from tron.priors import Track, untracked
from tron.priors.linear_light import ToneCurve, linear_light
from tron.reconstruction.light_scale import reduced, reduced_camera
from tron.reconstruction.observations import CLIPPED
from tron.reconstruction.settings import Settings
from tron.reconstruction.surface_points import surface_mask
from tron.seeds import generator, integer
from tron.shading.bounce import BounceTransport
from tron.shading.fixed_rays import FixedRays
from tron.shading.lighting import Lighting
from tron.shading.transport import Transport
from tron.tracing import SurfelTracer
from tron.tracing.parameters import SurfelParameters
from tron.tracing.tiles import tile_pixels

_DARK = 0.1
_LIKE = 6  # neighbours of like colour
_CHROMA = 0.3  # log colour that counts as one spacing


class RefinementSettings(Settings):
    """Refinement of materials against the photos."""

    steps: int = Field(default=0, ge=0, description="Steps; each shades one photo; 0 leaves materials alone.")
    views: int = Field(default=48, ge=1, description="Maximum number of photos.")
    pixels: int = Field(default=1 << 14, ge=1, description="Maximum pixels of each; larger ones are reduced.")
    rays: int = Field(default=16, ge=2, multiple_of=2, description="Shadow rays per pixel, even.")
    rate: float = Field(default=0.02, gt=0, description="Initial learning rate of all three, Adam's.")
    decay: float = Field(default=0.1, gt=0, le=1, description="Share of the rate that is left at the end.")
    tie: float = Field(default=0.1, ge=0, description="Weight of roughness and metallic staying.")
    even: float = Field(default=0.1, ge=0, description="Weight of neighbours being alike in them.")


@dataclass(frozen=True)
class _Photo:
    rays: FixedRays
    log_shown: mi.Color3f
    counts: mi.Float
    gain: mi.Color3f


class InverseRenderer:
    """A scene's materials under a light, and the photos they should explain.

    Args:
        scene: surfels with first materials.
        views: the photos. gains: (V, 3) exposure of each.
        exposure: of linear images. curve: of display images.
        settings: sizes, rates and weights.
        seed: root of views, rays and order.
        track: wraps the loop over the photos.
    """

    def __init__(
        self,
        scene: GaussianScene,
        views: Sequence[View],
        gains: np.ndarray,
        lighting: Lighting,
        exposure: float,
        curve: ToneCurve,
        settings: RefinementSettings,
        seed: int,
        track: Track = untracked,
    ) -> None:
        self.scene, self.settings, self.seed, self.lighting = scene, settings, seed, lighting
        self.parameters = SurfelParameters.from_scene(scene)
        self.tracer = SurfelTracer(scene, parameters=self.parameters)
        chosen = np.unique(np.linspace(0, len(views) - 1, settings.views).round().astype(int))
        self.photos: list[_Photo] = []
        bounce = BounceTransport.trace(self.tracer, seed=seed)
        first: FixedRays | None = None
        lights = [linear_light(views[i], exposure, curve) for i in chosen]
        self.dark = _DARK * float(np.mean([light.mean() for light in lights]))
        for i, light in track(list(zip(chosen, lights, strict=True)), "inverse rendering: photos"):
            first = self._add(views[i], light, gains[i], bounce, first)
        if not self.photos:
            raise TronError("no photo shows a surface of the scene", mend="check cameras and masks")
        self.first = {name: getattr(self.parameters, name) for name in MATERIALS}
        self.pairs = _like_pairs(scene)

    def _add(
        self,
        view: View,
        light: np.ndarray,
        gain: np.ndarray,
        bounce: BounceTransport,
        first: FixedRays | None,
    ) -> FixedRays | None:
        """Trace a photo's rays; those of the surfels are the first's."""
        settings, camera = self.settings, view.camera
        factor = max(1, int(np.ceil(np.sqrt(camera.width * camera.height / settings.pixels))))
        small = reduced_camera(camera, factor)
        ray_seed = integer(self.seed, "inverse rendering", view.name)
        estimation = Estimation(rays=settings.rays)
        if first is None:
            rays = first = FixedRays.trace(
                self.tracer, small, self.lighting.light, bounce, estimation, ray_seed
            )
        else:
            with dr.suspend_grad():
                gbuffer = self.tracer.gbuffer(small)
                pixels = Transport.trace(self.tracer, gbuffer, self.lighting.light, settings.rays, ray_seed)
            rays = replace(first, camera=small, pixels=pixels)
        gbuffer = self.tracer.gbuffer(small)
        solid = gbuffer.image(gbuffer.opacity) > 0.9
        shown = view.read().max(-1) if view.space == "display" else np.zeros(light.shape[:2])
        counts = surface_mask(view, np.ones(light.shape[:2], np.float32)) & (shown < CLIPPED)
        counts = (reduced(counts.astype(np.float32), factor) > 0.95) & solid
        if not counts.any():
            return first
        log_shown = np.log(reduced(light, factor) + self.dark).reshape(-1, 3)
        lane, inside = gbuffer.pixel, tile_pixels(small.width, small.height)[3]

        def lanes(values: np.ndarray) -> mi.Float:
            return dr.gather(mi.Float, mi.Float(aligned(values.astype(np.float32))), lane, inside)

        target = mi.Color3f(*[lanes(column) for column in log_shown.T])
        weight = lanes(counts.ravel() / max(counts.sum(), 1))
        dr.eval(target, weight)
        self.photos.append(
            _Photo(rays, target, weight, mi.Color3f(*[dr.opaque(mi.Float, float(g)) for g in gain]))
        )
        return first

    def refine(self, track: Track = untracked) -> GaussianScene:
        """The scene after ``settings.steps`` steps of Adam.

        Raises:
            TronError: the loss is not finite.
        """
        settings, count = self.settings, len(self.photos)
        adam = mi.ad.Adam(settings.rate, self.first, epsilon=1e-15)
        draw = generator(self.seed, "inverse rendering", "order")
        order = np.concatenate([draw.permutation(count) for _ in range(-(-settings.steps // count))])
        self.losses = []
        for step in track(range(settings.steps), "Materials"):
            for name in MATERIALS:
                setattr(self.parameters, name, adam[name])
            loss = self.loss(self.photos[order[step]]) + self._prior(adam)
            dr.backward(loss)
            adam.set_learning_rate(settings.rate * settings.decay ** (step / max(settings.steps - 1, 1)))
            adam.step()
            for name in MATERIALS:
                adam[name] = dr.clip(dr.detach(adam[name]), 0, 1)
            self.losses.append(float(loss[0]))
            if not np.isfinite(self.losses[-1]):
                raise TronError(f"the loss of the materials is {self.losses[-1]} at step {step}")
        found = {name: np.array(adam[name]).reshape(getattr(self.scene, name).shape) for name in MATERIALS}
        return replace(self.scene, **found)

    def loss(self, photo: _Photo) -> mi.Float:
        """Mean absolute log difference of ``lit`` from a photo."""
        _, colors = photo.rays.shade(self.lighting, background=(0.0, 0.0, 0.0))
        off = dr.abs(dr.log(dr.maximum(photo.gain * colors["lit"], 0) + self.dark) - photo.log_shown)
        return dr.sum((off.x + off.y + off.z) / 3 * photo.counts)

    def _prior(self, materials: mi.ad.Adam) -> mi.Float:
        """The regulariser of this module."""
        i, j, weight = self.pairs
        total = mi.Float(0)
        for name in ("roughness", "metallic"):
            value = materials[name]
            total += self.settings.tie * dr.mean(dr.square(value - self.first[name]))
            gap = dr.gather(mi.Float, value, i) - dr.gather(mi.Float, value, j)
            total += self.settings.even * dr.sum(weight * dr.square(gap))
        return total


def _like_pairs(scene: GaussianScene) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
    """Neighbours of like colour, and weights that sum to 1."""
    log = np.log(np.maximum(scene.base_color, 0.02))
    place = np.concatenate([scene.means / scene.spacing, log / _CHROMA], 1)
    distance, near = map(np.asarray, KDTree(place).query(place, k=min(_LIKE + 1, len(scene))))
    i, j = np.repeat(np.arange(len(scene)), near.shape[1] - 1), near[:, 1:].ravel()
    weight = np.exp(-(distance[:, 1:].ravel() ** 2) / 8)
    weight /= max(weight.sum(), 1e-12)
    return (
        mi.UInt32(aligned(i.astype(np.uint32))),
        mi.UInt32(aligned(j.astype(np.uint32))),
        mi.Float(aligned(weight.astype(np.float32))),
    )
