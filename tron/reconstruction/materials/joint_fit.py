"""Joint fit of a capture's light and materials, from its photos and the reconstructed geometry."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import Field
from scipy.spatial import KDTree

from tron.captures import Capture
from tron.captures.view import ToneCurve
from tron.color import MIDDLE_GREY, luminance
from tron.estimation import Estimation
from tron.gaussians import GaussianScene
from tron.reconstruction.light.fit_pairs import PATCH, Light, LightSettings, Points, TooFewSeen, fit_light
from tron.reconstruction.light.sky_visibility import PhotographedSky, photographed_sky, sky_transport
from tron.reconstruction.light.sun import Sun, SunSearch
from tron.reconstruction.light.surfel_colors import SurfelColors, mean_colors, observe
from tron.reconstruction.materials.brdf_search import Materials, Received, materials_of
from tron.reconstruction.progress import Track, untracked
from tron.reconstruction.settings import Settings
from tron.relighting import Relighter
from tron.runtime import aligned
from tron.seeds import generator
from tron.shading.bounces.bounce import BounceTransport
from tron.shading.bounces.bounce_rays import OWN
from tron.shading.environments.cubemap import CubemapLight
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.lighting import Lighting
from tron.tracing import SurfelTracer
from tron.tracing.hierarchy.first_hit import NOTHING

log = logging.getLogger(__name__)

MAP_HEIGHT = 256
"""Rows of the environment map; a sun narrower than a row is a row wide."""
_PHOTOS = 2
_USUAL = 0.6
"""Photos, and share of the usual number of them, that show a surfel whose colour tells of the light.

Where few look, as at a table's edge, surfels face anywhere.
"""
_METAL = 0.5  # metallic from here on: no diffuse part to speak of
_MIRRORS = 0.05  # share of the surfels from which it is said that they change with the view
_RAYS = 64  # shadow rays of a surfel
# Times one over the root of the surfels compared: what a sun explains where there is none. Up to 0.031 of 700
# (30 fits: seeds, jitter, widths of vectors, float64) and 0.021 of 1,214; a true one 0.089 and more.
_CHANCE = 0.95
_BACK = 0.5  # light of a back face as a share of what photos show of its front
_LEAST_DIRECT = 1e-4  # of the metered light, by channel: from less nothing can be scaled
_FILLED, _USUAL_ALBEDO, _WHITEST = 0.3, 0.25, 0.8
"""Share of a photo that its subject fills, albedo of what is around it, highest mean albedo of a subject."""


class JointSettings(Settings):
    """Settings of the joint fit."""

    tone_curve: ToneCurve | None = Field(
        default=None,
        description="Display curve of the images: srgb for photos, agx for path-traced ones; null: what the "
        "capture says.",
    )
    same_exposure: bool = Field(
        default=False, description="All photos are exposed and white-balanced alike; false: each by itself."
    )
    roughness: float = Field(default=0.6, ge=0, le=1, description="Roughness where no lobe is seen.")
    sun: float = Field(
        default=0.005, ge=0, le=1,
        description="Share of the differences between neighbours that a sun must explain to be one, and more "
        "than chance does among so many; 1: none.",
    )  # fmt: skip
    rounds: int = Field(default=1, ge=1, description="Times that light and materials are found in turns.")
    neutral: bool | None = Field(
        default=None,
        description="Mean irradiance over what the photos show is grey and as bright as a camera's meter "
        "has it, which balances white and exposes for what it sees; false: as it was found; null: of photos "
        "with a camera's display curve, srgb.",
    )
    light: LightSettings = Field(default=LightSettings(), description="Fit of the light.")


@dataclass(frozen=True)
class JointFit:
    """Light and materials that explain a capture's photos.

    Attributes:
        scene: the surfels with materials.
        environment: the light, in the unit of the photos over the capture's exposure.
        sun: the lobe within it; None if no shadows show a sun.
        colors: the surfel colours that the photos agree on.
        shown: (M, 3) linear radiance of the surfels; of a surfel without photo, its neighbours'.
        balance: (3,) factor by which the found light was too bright (:func:`light_balance`); ``environment``
            and ``sun`` are already divided by it. Ones if it was not computed.
        mirroring: share of the seen surfels that change with the view, :meth:`SurfelColors.mirroring`.
    """

    scene: GaussianScene
    environment: EnvironmentMap
    sun: Sun | None
    colors: SurfelColors
    shown: np.ndarray
    balance: np.ndarray
    mirroring: float

    def said(self) -> dict[str, Any]:
        """Plain values for a report."""
        sun = self.sun
        return {
            "sun": None
            if sun is None
            else {
                "direction": [round(float(x), 5) for x in sun.direction],
                "width_deg": round(float(np.degrees(sun.width)), 2),
            },
            "surfels_seen": round(float(self.colors.seen.mean()), 4),
            "mirroring": round(self.mirroring, 4),
            "spread": round(float(np.median(self.colors.spread[self.colors.seen])), 4),
            "balance": [round(float(x), 4) for x in self.balance],
        }


def fit_jointly(
    capture: Capture,
    scene: GaussianScene,
    prior: JointSettings,
    seed: int,
    track: Track = untracked,
) -> JointFit:
    """Find light and materials on frozen surfels.

    Args:
        capture: its training views are used.
        scene: geometry; its materials are ignored.
        prior: settings.
        seed: root of the random numbers.
        track: wraps long loops.

    Raises:
        TooFewSeen: the photos show too few of the surfels.
        TronError: a loss is not finite.
    """
    relighter, curve = Relighter(scene, seed=seed, proxy="never"), prior.tone_curve or capture.tone_curve
    tracer = relighter.tracer(capture.train_views[0].camera)
    found = observe(tracer, capture.train_views, capture.exposure, curve, track)
    colors = mean_colors(found, prior.same_exposure)
    if not colors.seen.any():
        raise TooFewSeen(
            "no surfel is shown well enough by two photos",
            mend="take larger pictures (max_side=) and more steps; cameras and masks must be the scene's",
        )
    shown = _everywhere(colors, scene)
    mirroring = colors.mirroring(scene.means)
    if mirroring >= _MIRRORS:
        log.warning(
            "%.0f %% of what is seen changes with the view as mirrors, polished metal, black gloss and glass "
            "do: neither its shape nor its materials are to be relied on",
            100 * mirroring,
        )
    transport = relighter.transport
    bounced = photographed_bounces(transport, shown)
    sky = photographed_sky(
        tracer, capture.train_views, colors.gain, capture.exposure, curve,
        prior.light.resolution, seed, track,
    )  # fmt: skip
    finder = LightFinder(tracer, colors, bounced, sky, prior, seed)
    photos = curve == "srgb" and capture.train_views[0].space == "display"
    neutral = photos if prior.neutral is None else prior.neutral
    diffuse, metallic = shown, np.zeros(len(scene), np.float32)
    for _ in range(prior.rounds):
        light, sun = finder.find(diffuse, metallic)
        environment = environment_of(light, sun)
        received = receive(transport, Lighting(environment), bounced, seed)
        balance = light_balance(received, colors) if neutral else np.ones(3, np.float32)
        environment, received = EnvironmentMap(environment.image / balance), received.balanced(balance)
        sun = None if sun is None else replace(sun, strength=sun.strength / balance)
        materials = materials_of(scene, found, colors, Lighting(environment), received, prior.roughness)
        # Colours without highlights and metals determine the light better.
        diffuse = materials.base_color * received.total
        metallic = materials.metallic
    environment = EnvironmentMap(environment.image / np.float32(capture.exposure))
    return JointFit(_with(scene, materials), environment, sun, colors, shown, balance, mirroring)


def light_balance(received: Received, colors: SurfelColors) -> np.ndarray:
    """(3,) factor by which a found light is too bright for a camera that balances white and meters.

    Photos give the bounced light I in their own unit, independently of the found light. So only the direct
    light E is scaled, until the sum is the metered light W (:func:`metered_light`), in the mean over all
    seen surfels:

        E / b + I = W      so      b = E / (W - I)

    In a closed room of albedo a, I = a (E + I). Albedo is below 0.8, so I is limited to 0.8 W: if photos show
    more, such as red in a red room, direct light keeps a fifth of W.

    Args:
        received: light at the surfels from the found light.
        colors: the surfels' colours in the photos.
    """
    direct, bounced = (each[colors.seen].mean(0) for each in (received.direct, received.bounced))
    wanted = metered_light(float(luminance(colors.color[colors.seen].mean(0))))
    lit = direct > _LEAST_DIRECT * wanted
    if not lit.all():
        log.warning("no light reaches what photos show but by bounces: its brightness is as it was found")
    if (bounced > _WHITEST * wanted).any():
        log.warning("nearly all light that photos show has bounced: the brightness of its source is a guess")
    factor = direct / np.maximum(wanted - bounced, (1 - _WHITEST) * wanted)
    return np.where(lit, factor, 1).astype(np.float32)


def metered_light(shown: float) -> float:
    """Mean irradiance / pi over a subject, in the unit of its photos, by the camera that exposed them.

    A meter sets the mean radiance in the camera's view to middle grey. A subject of albedo a fills the share
    f of the view; the rest has an average albedo b and the same light:

        E (f a + (1 - f) b) = 0.18,   shown = E a      so      E = (0.18 - f shown) / ((1 - f) b)

    0.72 for a subject as bright as its surroundings; 1 for one in black leather.

    Args:
        shown: mean linear light that the photos show of the subject; 1 is their white.
    """
    light = (MIDDLE_GREY - _FILLED * shown) / ((1 - _FILLED) * _USUAL_ALBEDO)
    return max(light, shown / _WHITEST)


class LightFinder:
    """Finds light from the colours of some surfels seen in photos, whose rays are traced once.

    Args:
        tracer: the surfels.
        colors: their colours in the photos.
        bounced: (M, 3) irradiance / pi of bounced light.
        sky: the sky in the photos.
        prior, seed: as in :func:`fit_jointly`.
    """

    def __init__(
        self,
        tracer: SurfelTracer,
        colors: SurfelColors,
        bounced: np.ndarray,
        sky: PhotographedSky,
        prior: JointSettings,
        seed: int,
    ) -> None:
        self.tracer, self.prior, self.seed = tracer, prior, seed
        self.sky = sky
        scene = tracer.scene
        usual = np.median(colors.count[colors.seen])
        usable = np.flatnonzero(colors.count >= max(_PHOTOS, _USUAL * usual))
        draw = generator(seed, "joint light", "points")
        self.chosen = np.sort(draw.permutation(usable)[: prior.light.points])
        self.position, self.normal = scene.means[self.chosen], scene.normals()[self.chosen]
        self.bounced = bounced[self.chosen]
        self.transport = sky_transport(tracer, self.position, self.normal, prior.light.resolution, seed)

    def find(self, diffuse: np.ndarray, metallic: np.ndarray) -> tuple[Light, Sun | None]:
        """The light, and the sun in it, if shadows tell of one.

        Args:
            diffuse: (M, 3) diffuse radiance of the surfels.
            metallic: (M,); surfels above a half do not count.
        """
        settings, seed = self.prior.light, self.seed
        kept = metallic[self.chosen] < _METAL
        surfels = Points(
            self.position[kept],
            self.normal[kept],
            diffuse[self.chosen][kept],
            self.bounced[kept],
            self.transport[kept],
        )
        radius = PATCH * self.tracer.scene.spacing
        points = surfels.averaged(surfels.patches(radius))
        soft = fit_light(points, settings, seed, self.sky)
        if self.prior.sun >= 1:
            return soft, None
        search = SunSearch(self.tracer, surfels, soft, radius, seed)
        direction, strength = search.find()
        width, strength = search.width(direction, strength)
        lit = replace(points, lobe=search.received(direction, width))
        begin = replace(soft, sun=np.full(3, strength * search.rest.mean(), np.float32))
        sunny = fit_light(lit, settings, seed, self.sky, begin)
        gain = 1 - search.loss(sunny, lit) / search.loss(soft, points)
        log.info("a sun explains %.1f %% of the differences between neighbours", 100 * gain)
        if gain < max(self.prior.sun, _CHANCE / np.sqrt(kept.sum())):
            return soft, None
        return sunny, Sun(direction, width, sunny.sun)


def receive(transport: BounceTransport, lighting: Lighting, bounced: np.ndarray, seed: int) -> Received:
    """Light at all surfels."""
    estimation = Estimation(rays=_RAYS)
    with dr.suspend_grad():
        unshadowed = np.array(lighting.split_sum.diffuse(mi.Vector3f(transport.surfels().normal))).T
        share = np.array(transport.visible(lighting, estimation, seed)).T
        openness = np.array(transport.openness())
    return Received(unshadowed * share, unshadowed, bounced, openness)


def photographed_bounces(transport: BounceTransport, shown: np.ndarray) -> np.ndarray:
    """(M, 3) irradiance / pi of bounced light at surfels whose radiance (M, 3) is given by photos."""
    code = np.array(transport.rays.met).reshape(-1, len(shown))
    sent = np.concatenate([shown, np.zeros((1, 3), shown.dtype)])
    total = np.zeros_like(shown)
    itself = np.arange(len(shown))
    for ray in code:
        own, met = (ray & OWN) > 0, (ray & (OWN - 1)) >> 1
        share = np.where(((ray & 1) > 0) & ~own, _BACK, 1.0).astype(np.float32)
        total += share[:, None] * sent[np.where(ray == NOTHING, len(shown), np.where(own, itself, met))]
    return total / len(code)


def _everywhere(colors: SurfelColors, scene: GaussianScene) -> np.ndarray:
    """(M, 3) colours of all surfels; a surfel without photo gets the mean of its nearest seen surfels."""
    seen = np.flatnonzero(colors.seen)
    near = np.reshape(KDTree(scene.means[seen]).query(scene.means, k=min(4, len(seen)))[1], (len(scene), -1))
    guessed = colors.color[seen[near]].mean(1)
    return np.where(colors.seen[:, None], colors.color, guessed).astype(np.float32)


def _with(scene: GaussianScene, materials: Materials) -> GaussianScene:
    return replace(
        scene,
        base_color=np.clip(materials.base_color, 0, 1),
        roughness=np.clip(materials.roughness, 0, 1),
        metallic=np.clip(materials.metallic, 0, 1),
    )


def environment_of(light: Light, sun: Sun | None) -> EnvironmentMap:
    """The light as a lat-long map."""
    resolution = round((len(light.texels) / 6) ** 0.5)
    texels = mi.Float(aligned(light.texels.astype(np.float32).ravel()))
    image = CubemapLight(texels, resolution).to_environment(MAP_HEIGHT).image
    if sun is not None:
        image = image + _lobe_image(sun)
    return EnvironmentMap(image)


def _lobe_image(sun: Sun) -> np.ndarray:
    """(H, 2 H, 3) float32 map of the lobe alone, scaled to its irradiance at any resolution."""
    height = MAP_HEIGHT
    polar = np.arange(height)[:, None] * np.pi / (height - 1)
    around = (np.arange(2 * height) + 0.5)[None] * np.pi / height
    directions = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.sin(around), np.sin(polar) * np.cos(around), np.cos(polar)), -1
    )
    wide = replace(sun, width=max(sun.width, np.pi / height))
    image = wide.radiance(directions)
    cosine = np.maximum(directions @ sun.direction, 0)
    solid = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32)).solid_angles()[:, None]
    received = np.einsum("ij,ijc->c", cosine * solid / np.pi, image)
    return (image * (sun.strength / np.maximum(received, 1e-20))).astype(np.float32)
