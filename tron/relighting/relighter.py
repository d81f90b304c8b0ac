"""A scene that can be lit: makes a proxy, traces bounces, chooses sides and bakes light.

    relighter = Relighter(GaussianScene.load("scene.ply"), Estimation(rays=64))
    light = relighter.under(EnvironmentMap.load("studio.hdr").rotated(90))   # bakes once
    frame = light.render(camera)
    frame.write("lit.png")                                                   # exposed, AgX
    moved = relighter.bring(scene2, light.lighting, before=light)            # redoes only what has to be

What bounces depends on the scene, traced once, and on the light and its turn, baked for each; not on the
camera. One :class:`Estimation` reaches the tracer's sides, the rays between surfels, the bake and the frames.

Light does not see a scan that is thick, nor one whose normals have no sign, as those of plain 3DGS files: it
sees a proxy, one layer of oriented surfels (:mod:`tron.relighting.proxy`). Cameras see the scan itself, whose
surfels without a sign are turned to each of them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.cameras import Camera
from tron.denoising import denoised
from tron.errors import TronError
from tron.estimation import FINAL, Estimation
from tron.gaussians.edit import subset
from tron.gaussians.scene import GaussianScene
from tron.relighting.beside import BesideMeshes, LightTracer, some_of
from tron.relighting.ground import GroundOf
from tron.relighting.proxy import THICK, Choice, ProxiedTracer, Proxy, fingerprint, make_proxy, thickness
from tron.runtime import activate
from tron.shading.bounces.bounce import BouncedLight, BounceTransport
from tron.shading.environments.cubemap import CubemapLight
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import (
    Arriving,
    Guidance,
    arriving_light,
    shade,
    shade_surface,
    surface_maps,
    trace_views,
)
from tron.shading.lighting import Lighting
from tron.tracing import GBuffer, SurfelTracer
from tron.tracing.meshes import Meshes
from tron.tracing.surface import Surface, centres

if TYPE_CHECKING:
    from tron.models.parts import Part

log = logging.getLogger(__name__)

Light = EnvironmentMap | CubemapLight | Lighting
REACH = ("oriented", "spacing", "kernel_degree", "projection", "log_scales", "opacity_logits")
"""Fields that decide the extent and back faces of surfels: if one differs, all rays are traced again."""


class Relighter:
    """A scene that any number of lights can light. If no Mitsuba variant is set, it sets ``llvm_ad_rgb``.

    Args:
        scene: the surfels, valid (``scene.validate()``); they must not change while this object lives.
        estimation: how light is estimated, in all tracing, baking and rendering.
        seed: root of the random numbers of rays between surfels, and of bakes without a seed of their own.
        backdrop: (M,) bool, surfels that cameras see, from their front side, but that block no light.
        track: wraps the loop over rays of the surfels, to show progress.
        proxy: whether light is computed on a proxy: auto (if the scene is thick or its normals have no sign),
            always, never; or an existing proxy.
        cameras: of the scene's photos, as views for the proxy; None: cameras around the scene.
        proxy_file: PLY that keeps the proxy; read if it was made from the same scene, else written.
        filming: wraps the loop over the proxy's views, to show progress.
        ground: plane on which the scene stands and casts shadows, where frames show the environment; or a
            function that gives it for a camera.
        meshes: models, each as :func:`tron.models.load.load_model` reads it, where they stand, in the scene's
            world and units: opaque things beside the surfels (:mod:`tron.tracing.meshes`).
    """

    def __init__(
        self,
        scene: GaussianScene,
        estimation: Estimation = FINAL,
        seed: int = 0,
        *,
        backdrop: np.ndarray | None = None,
        track: Callable[[range], Iterable[int]] = iter,
        proxy: Choice | Proxy = "auto",
        cameras: Sequence[Camera] | None = None,
        proxy_file: Path | None = None,
        filming: Callable[[range], Iterable[int]] = iter,
        ground: GroundOf = None,
        meshes: Sequence[Sequence[Part]] = (),
    ) -> None:
        if mi.variant() is None:
            activate()
        self.scene, self.estimation, self.seed = scene, estimation, seed
        self._backdrop, self._track, self.ground = backdrop, track, ground
        self._choice, self._cameras, self._proxy_file, self._filming = proxy, cameras, proxy_file, filming
        self._tracer = SurfelTracer(scene, backdrop=backdrop).sided(estimation.two_sided)
        self._turned_to: tuple[bytes, SurfelTracer] | None = None
        self.frame_seed = 0  # of frames that are given none
        self._refitted = False  # whether something has moved in the hierarchy
        self.meshes = Meshes(meshes, seed) if meshes else None

    def tracer(self, camera: Camera) -> SurfelTracer | ProxiedTracer | BesideMeshes:
        """Return the tracer for a camera: one for all cameras, unless surfels are turned towards each."""
        seen = self._seen_by(camera)
        tracer = seen if self._proxied is None else self._proxied.showing(seen)
        return tracer if self._beside is None else BesideMeshes(tracer, self._beside)

    def _seen_by(self, camera: Camera) -> SurfelTracer:
        """The scene itself; surfels without a sign are turned to the camera, but not those of a backdrop."""
        if self.scene.oriented:
            return self._tracer
        position = camera.position.tobytes()
        if self._turned_to is None or self._turned_to[0] != position:
            away = self.scene.looks_away(camera.position)
            turned = away if self._backdrop is None else away & ~self._backdrop
            self._turned_to = position, self._tracer.turned_over(turned)
        return self._turned_to[1]

    @cached_property
    def proxy(self) -> Proxy | None:
        """The proxy on which light is computed, made at first use; None: the scene itself is used."""
        if isinstance(self._choice, Proxy):
            return self._choice
        content = self.scene if self._backdrop is None else subset(self.scene, ~self._backdrop)
        tracer = self._tracer if self._backdrop is None else SurfelTracer(content)
        needed, said = self._needs_proxy(tracer)
        if not needed:
            if said:
                log.info("%s: light sees the scan itself", said)
            return None
        made_from = "" if self._proxy_file is None else fingerprint(content, self._cameras)
        kept = None if self._proxy_file is None else Proxy.load(self._proxy_file, made_from)
        if kept is not None:
            log.info("%s: light sees the proxy of %s, %d surfels", said, self._proxy_file, len(kept.surfels))
            return kept
        try:
            made = make_proxy(tracer, self._cameras, self._filming)
        except (KeyboardInterrupt, SystemExit) as end:
            end.add_note("the proxy begins anew; what was finished before it is kept")
            raise
        if made is None:
            log.warning("%s, but views of the scene agree on no surface: light sees the scan itself", said)
            return None
        log.info("%s: light sees a proxy of %d surfels", said, len(made.surfels))
        if self._proxy_file is not None:
            try:
                made.save(self._proxy_file, made_from)
            except TronError as error:
                log.info("the proxy is not kept: %s", error)
        return made

    @property
    def _stays(self) -> Choice:
        """Whether light sees a proxy of what becomes of the scene: as it does of this one."""
        always = self._choice == "always" or (self._choice != "never" and self.proxy is not None)
        return "always" if always else "never"

    def _needs_proxy(self, tracer: SurfelTracer) -> tuple[bool, str]:
        """Whether light sees a proxy, and why, in words; empty words where nobody has to know."""
        if self._choice == "never":
            return False, ""
        if self._choice == "always":
            return True, "proxy=always"
        thick = thickness(tracer, self._cameras)
        said = f"{thick:.0%} of the opaque pixels are thicker than a spacing (thick from {THICK:.0%} on)"
        if thick >= THICK:
            return True, said
        if not self.scene.oriented:
            return True, f"{said}, and normals have no sign"
        return False, ""

    @cached_property
    def _proxied(self) -> ProxiedTracer | None:
        proxy = self.proxy
        if proxy is None:
            return None
        light = SurfelTracer(proxy.surfels).sided(self.estimation.two_sided)
        return ProxiedTracer(self._tracer, light, proxy.voxel, self._backdrop)

    @cached_property
    def _outward(self) -> np.ndarray:
        """(M,) bool: surfels that look at the middle of the scene."""
        return ~self.scene.looks_away(np.median(self.scene.means, axis=0))

    @property
    def _light(self) -> SurfelTracer:
        """Surfels that light bounces among: the proxy's, or the scene's, turned outward without a sign.

        Behind them those that stand for meshes.
        """
        return self._surfels_of_light if self._beside is None else self._beside

    @property
    def _surfels_of_light(self) -> SurfelTracer:
        if self._proxied is not None:
            return self._proxied.light
        return self._tracer if self.scene.oriented else self._tracer.turned_over(self._outward)

    @cached_property
    def _beside(self) -> LightTracer | None:
        if self.meshes is None:
            return None
        backdrop = self._backdrop if self._proxied is None else None
        traced = LightTracer(self._surfels_of_light, self.meshes, backdrop)
        return traced.sided(self.estimation.two_sided)

    def surfels(self, values: Sequence[mi.Float] = ()) -> Surface:
        """Return the M surfels at their centres, with the sides used for light and ``values`` of a bake."""
        emission = self._tracer.emission
        if self._proxied is not None:
            return replace(self._proxied.surfels(values), emission=emission)
        count = len(self.scene)
        found = centres(self._light.records, dr.arange(mi.UInt32, count))
        own = values if self._beside is None else [some_of(value, 0, count) for value in values]
        return replace(found, values=list(own), emission=emission)

    def gbuffer(self, camera: Camera, values: Sequence[mi.Float] = ()) -> GBuffer:
        """Trace a camera's G-buffer; ``values`` of the surfels used for light are composited too."""
        return self.tracer(camera).gbuffer(camera, values)

    def surface_maps(self, camera: Camera, *estimations: Estimation) -> list[dict[str, np.ndarray]]:
        """:func:`tron.shading.guidance.surface_maps` of a view, for frames of some estimations."""
        return surface_maps(self.tracer(camera), camera, estimations)

    @cached_property
    def transport(self) -> BounceTransport:
        """Light transport between the surfels used for light, traced at first use."""
        return BounceTransport.trace(self._light, seed=self.seed, track=self._track)

    def prepare(self) -> Relighter:
        """Compute now everything that does not depend on the light; return the relighter itself."""
        _ = self.transport if self.estimation.bounces else self.proxy
        return self

    def under(self, light: Light, seed: int | None = None, *, quick: bool = False) -> Illumination:
        """Bake the direct and bounced light of one environment at one rotation.

        Args:
            light: an environment, or one that is prepared; this one's gradients end at the bake.
            seed: root of the shadow rays of surfels; None: the relighter's.
            quick: with few rays of surfels, for frames that are looked at while something moves.
        """
        lighting = light if isinstance(light, Lighting) else Lighting(light)
        baked, seed = None, self.seed if seed is None else seed
        if self.estimation.bounces:
            bake = self.transport.bake_quickly if quick else self.transport.bake
            baked = self._seen(bake(lighting, self.estimation, seed=seed))
        return Illumination(self, lighting, self.estimation, seed, baked, quick)

    def _seen(self, baked: BouncedLight) -> BouncedLight:
        if self._proxied is None and not self.scene.oriented:  # a camera may see the side that was not baked
            return replace(baked, reaching=None)
        return baked

    def bring(
        self,
        scene: GaussianScene,
        light: Light,
        rotation: float | None = None,
        *,
        before: Illumination | None = None,
        seed: int | None = None,
        quick: bool = False,
        anew: bool = False,
        proxy: Proxy | None = None,
        meshes: Meshes | None = None,
    ) -> Illumination:
        """Return a scene under a light, recomputing only what changed.

        ================  =============  ===============================================================
        scene             light          what is done
        ================  =============  ===============================================================
        this one's        ``before``'s   nothing
        this one's        another        a bake
        other materials   ``before``'s   what bounces is followed again: shadows stay, to the bit
        other materials   another        a bake
        moved             any            a refit, rays that have changed, a bake (:meth:`changed`)
        any other         any            all
        ================  =============  ===============================================================

        Args:
            scene: this relighter's, or another.
            light: an environment, or one that is prepared; the same object as before where it is the same.
            rotation: of it about +z, degrees; None: as it is.
            before: what there is; of the same light, whatever the scene, or of another.
            seed: root of the shadow rays of surfels; None: the relighter's.
            quick: as it is looked at while something moves: few rays of surfels. Where its proxy would have
                to be made anew, the scene stays where it is.
            anew: not a ray as something moved has left it: as if nothing had been before.
            proxy, meshes: as of :meth:`changed`.
        """
        relighter, stands = self, self._stands_as(scene)
        same = scene is self.scene and (meshes is None or meshes is self.meshes)
        if anew and (self._refitted or not stands):
            relighter = self._anew(scene, self._stays, meshes).prepare()
        elif not same and not (quick and not stands and proxy is None and self.proxy is not None):
            relighter = self.changed(scene, quick=quick, proxy=proxy, meshes=meshes)
        return relighter._under(light, rotation, before, relighter.seed if seed is None else seed, quick)

    def _under(
        self, light: Light, rotation: float | None, before: Illumination | None, seed: int, quick: bool
    ) -> Illumination:
        """This scene under a light, of which ``before`` may have a bake."""
        turn = None if rotation is None else rotation % 360
        if before is not None and before.seed == seed and (quick or not before.quick):
            given = before.lighting if before.source is None else before.source
            if given is light and before.turn == turn:
                if before.relighter is self:
                    return before
                if before.bounced is not None and self._stands_like(before.relighter):
                    baked = self._seen(self.transport.rebaked(before.bounced, self.estimation))
                    return replace(before, relighter=self, estimation=self.estimation, bounced=baked)
        lighting = light if isinstance(light, Lighting) else Lighting(light)
        lighting = lighting if rotation is None else lighting.turned_to(rotation)
        return replace(self.under(lighting, seed, quick=quick), source=light, turn=turn)

    def _stands_like(self, other: Relighter) -> bool:
        """Whether surfels and the light's rays among them are those of another relighter."""
        traced = (self._surfels_of_light.bvh.order, self.estimation, self.seed)
        others = (other._surfels_of_light.bvh.order, other.estimation, other.seed)
        alike = traced[0] is others[0] and traced[1:] == others[1:] and self.meshes is other.meshes
        return self._stands_as(other.scene) and alike

    def _stands_as(self, scene: GaussianScene) -> bool:
        """Whether a scene is this one but for materials and radiance."""
        return len(scene) == len(self.scene) and _same(self.scene, scene, (*REACH, "means", "quats"))

    def changed(
        self,
        scene: GaussianScene,
        *,
        quick: bool = False,
        proxy: Proxy | None = None,
        meshes: Meshes | None = None,
    ) -> Relighter:
        """Return a relighter of a changed scene that shares everything unchanged; this one stays as it is.

        Where surfels have moved or have other materials, the hierarchy is refitted and only rays that have
        changed are traced again: as if all were, to the bit. Rays are drawn in the hierarchy's order, which a
        refitted one keeps, so that what has moved has other noise than in a new ``Relighter``. A proxy is
        made anew unless materials alone differ. Where sizes or opacities differ, or surfels come or go, all
        is made anew; beside meshes, all rays are. Whether there is a proxy stays as it was.

        Args:
            scene: the other scene.
            quick: rays between surfels are not traced again, for ``under(quick=True)`` while something moves.
            proxy: that of the other scene, where light sees one; None: it is made.
            meshes: where they are now, such as ``relighter.meshes.moved(..)``; None: where they were.

        Raises:
            TronError: another number of surfels than the backdrop has.
        """
        before = self.scene
        if self._backdrop is not None and len(scene) != len(self._backdrop):
            raise TronError("surfels have come or gone before a backdrop", mend="make a new Relighter")
        choice: Choice | Proxy = proxy if proxy is not None and self.proxy is not None else self._stays
        stands = self._stands_as(scene)
        painted = self.proxy if stands and proxy is None else None
        if not _same(scene, before, REACH) or (painted is None and self.proxy is not None):
            return self._anew(scene, choice, meshes)
        other = copy(self)
        other._refitted = self._refitted or not stands
        other.meshes = meshes or self.meshes
        other.__dict__.pop("_beside", None)
        other.scene, other._tracer, other._turned_to = scene, self._tracer.moved(scene), None
        if painted is not None and self._proxied is not None:
            content = scene if self._backdrop is None else subset(scene, ~self._backdrop)
            other.__dict__["proxy"] = painted = painted.painted(content)
            other.__dict__["_proxied"] = self._proxied.painted(other._tracer, painted.surfels)
        traced = other.__dict__.pop("transport", None)
        # Rays that look for moved surfels alone would find those of a backdrop too, and are not those of a
        # hierarchy that was sorted anew.
        kept = other._tracer.bvh.order is self._tracer.bvh.order and (stands or self._backdrop is None)
        kept &= other.meshes is None
        if traced is not None and kept:
            carried = traced.carried if quick else traced.moved
            other.__dict__["transport"] = carried(other._light)
        return other

    def _anew(self, scene: GaussianScene, proxy: Choice | Proxy, meshes: Meshes | None) -> Relighter:
        """A new relighter of another scene; what is kept of the scan is not of that."""
        anew = Relighter(
            scene, self.estimation, self.seed, backdrop=self._backdrop, track=self._track,
            proxy=proxy, cameras=self._cameras, filming=self._filming, ground=self.ground,
        )  # fmt: skip
        anew.meshes, anew.frame_seed = meshes or self.meshes, self.frame_seed
        return anew


@dataclass(frozen=True)
class Illumination:
    """A scene under one light; made by :meth:`Relighter.under`.

    Attributes:
        relighter: the scene.
        lighting: the prepared environment.
        estimation: of frames: the relighter's but for what :meth:`framed` has changed.
        seed: root of the shadow rays of surfels.
        bounced: the bake, at the surfels that light sees; None where nothing bounces.
        quick: whether the bake is of few rays.
        source, turn: what :meth:`Relighter.bring` was given as the light; None: the environment, as it is.
    """

    relighter: Relighter
    lighting: Lighting
    estimation: Estimation
    seed: int
    bounced: BouncedLight | None
    quick: bool = False
    source: Light | None = None
    turn: float | None = None

    def turned_to(self, rotation_deg: float) -> Illumination:
        """Rotate the same environment about +z and bake again, without preparing it again.

        Raises:
            TronError: the light is a cubemap.
        """
        return self.relighter.under(self.lighting.turned_to(rotation_deg), self.seed)

    def framed(
        self,
        *,
        rays: int | None = None,
        filtered: bool | None = None,
        reflections: int | None = None,
        supersample: int | None = None,
    ) -> Illumination:
        """Reuse the bake for frames with other per-pixel settings of :class:`Estimation`."""
        given = {"rays": rays, "filtered": filtered, "reflections": reflections, "supersample": supersample}
        wanted: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        other = Estimation.model_validate(self.estimation.model_dump() | wanted)
        return replace(self, estimation=other)

    def trace(self, camera: Camera, seed: int | None = None, view: GBuffer | None = None) -> TracedFrame:
        """Trace all rays of a frame (arguments as of :meth:`render`)."""
        seed = self.relighter.frame_seed if seed is None else seed
        tracer, bounce = self.relighter.tracer(camera), self.bounced
        if view is None:
            (view,) = trace_views(tracer, camera, self.estimation, [bounce])
        arriving = arriving_light(tracer, view, self.lighting, self.estimation, seed, bounce)
        ground = self.relighter.ground
        ground = ground(camera) if callable(ground) else ground
        if ground is not None:
            arriving.behind = ground.behind(tracer, view, camera, self.lighting, self.estimation, seed)
        return TracedFrame(self.lighting, self.estimation, view, arriving)

    def render(
        self,
        camera: Camera,
        seed: int | None = None,
        background: Sequence[float] | None = None,
        view: GBuffer | None = None,
        denoise: str | None = None,
    ) -> Guidance:
        """Render all buffers of one frame, linear.

        Args:
            camera: the view.
            seed: root of the random numbers of its rays; None: the relighter's ``frame_seed``, which is 0.
            background: linear RGB radiance behind the surfels; None: the environment.
            view: what the camera sees, where it is traced already (:func:`views_under`).
            denoise: name of a denoiser: as :meth:`TracedFrame.denoised`.
        """
        frame = self.trace(camera, seed, view)
        if denoise is not None:
            frame = frame.denoised(denoise, self.relighter.surface_maps(camera, self.estimation)[0])
        return frame.shade(background)


@dataclass(frozen=True)
class TracedFrame:
    """A frame whose rays are traced; it can be shaded in front of any background.

    Attributes:
        view: what the camera sees, of sub-pixels, if so.
        arriving: the light that reaches it.
        noise: (H, W, 3) radiance that is taken away from ``lit``, 0 where no surfel is; None: nothing.
    """

    lighting: Lighting
    estimation: Estimation
    view: GBuffer
    arriving: Arriving
    noise: np.ndarray | None = None

    def shade(self, background: Sequence[float] | None = None) -> Guidance:
        """Shade the frame; ``background`` as of :meth:`Illumination.render`."""
        frame = shade(self.view, self.arriving, self.lighting, background, self.estimation)
        if self.noise is None:
            return frame
        lit = np.maximum(frame.lit - self.noise, 0)
        return replace(frame, lit=lit, shadowed=frame.shadowed if self.estimation.bounces else lit)

    def images(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        """Return (H, W, 3) buffers of :meth:`shade` alone, for a frame without sub-pixels and denoising."""
        colors = shade_surface(self.view, self.arriving, self.lighting, None, self.estimation.brdf)
        return self.view.images({name: colors[name] for name in names})

    def denoised(self, denoiser: str, maps: Mapping[str, np.ndarray]) -> TracedFrame:
        """Return the frame with a denoised ``lit`` (:mod:`tron.denoising`).

        So is ``shadowed`` where nothing bounces; the other buffers are as they were, and so is what stands
        behind the surfels, which has no noise but for shadows on a ground.

        Args:
            denoiser: its name.
            maps: (H, W, 3) each, :func:`tron.shading.guidance.surface_maps` of the view.

        Raises:
            TronError: its library is not there.
        """
        over_black = replace(self, noise=None).shade((0, 0, 0))
        guides = {**maps, "normal": over_black.gbuffer["normal"]}
        noise = over_black.lit - denoised(denoiser, over_black.lit, guides)
        return replace(self, noise=np.where(over_black.mask[..., None] > 0, noise, 0))


def _same(scene: GaussianScene, other: GaussianScene, names: Iterable[str]) -> bool:
    return all(np.array_equal(getattr(scene, name), getattr(other, name)) for name in names)


def views_under(lights: Sequence[Illumination], camera: Camera) -> list[GBuffer]:
    """Trace a camera's view once for all lights of one relighter that share it."""
    tracer = lights[0].relighter.tracer(camera)
    views: dict[int, GBuffer] = {}
    seeing = [(light.estimation.supersample, light.estimation.rays > 0) for light in lights]
    for kind in dict.fromkeys(seeing):
        alike = [k for k, other in enumerate(seeing) if other == kind]
        bounces = [lights[k].bounced for k in alike]
        views |= zip(alike, trace_views(tracer, camera, lights[alike[0]].estimation, bounces), strict=True)
    return [views[k] for k in range(len(lights))]
