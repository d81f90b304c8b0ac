"""A scene that can be lit: the one place that traces bounces, picks the sides of surfels and bakes light.

    relighter = Relighter(GaussianScene.load("scene.ply"), Estimation(rays=64))
    light = relighter.under(EnvironmentMap.load("studio.hdr").rotated(90))   # bakes once
    frame = light.render(camera)
    frame.write("lit.png")                                                   # exposed, AgX
    moved = relighter.changed(scene2)                                        # retraces only what has to be

What bounces depends on the scene, traced once, and on the light and its turn, baked for each; not on the
camera. One :class:`Estimation` reaches the tracer's sides, the rays between surfels, the bake and the frames.

Normals of plain 3DGS files have no sign, and their surfels are turned to each camera, which takes a tracer a
camera. Their light is not traced anew for each, which would take longer than the frame: it is traced for both
sides of every surfel, and each camera is shown the sides that face it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np

from tron.cameras import Camera
from tron.errors import TronError
from tron.estimation import FINAL, Estimation
from tron.gaussians.scene import GaussianScene
from tron.runtime import activate
from tron.shading.bounces.bounce import BothSides, BouncedLight, BounceTransport, facing
from tron.shading.environments.cubemap import CubemapLight
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Arriving, Guidance, arriving_light, shade, surface_maps, trace_views
from tron.shading.lighting import Lighting
from tron.tracing import GBuffer, SurfelTracer

Light = EnvironmentMap | CubemapLight | Lighting
REACH = ("oriented", "spacing", "kernel_degree", "log_scales", "opacity_logits")
"""What decides how far surfels reach, and their backs: where one differs, all rays may."""


class Relighter:
    """A scene to be lit by any number of lights. Where no Mitsuba variant is set, ``llvm_ad_rgb`` is.

    Args:
        scene: the surfels, valid (``scene.validate()``); they must not change while this object lives.
        estimation: of the light, for all that is traced, baked and rendered.
        seed: root of the random numbers of rays between surfels, and of bakes that are given no other.
        backdrop: (M,) bool, surfels that are seen, from the side they show, and in no light's way.
        track: wraps the loop over rays of the surfels, to show progress.
    """

    def __init__(
        self,
        scene: GaussianScene,
        estimation: Estimation = FINAL,
        seed: int = 0,
        *,
        backdrop: np.ndarray | None = None,
        track: Callable[[range], Iterable[int]] = iter,
    ) -> None:
        if mi.variant() is None:
            activate()
        self.scene, self.estimation, self.seed = scene, estimation, seed
        self._backdrop, self._track = backdrop, track
        self._tracer = SurfelTracer(scene, backdrop=backdrop).sided(estimation.two_sided)
        self._turned_to: tuple[bytes, SurfelTracer] | None = None

    def tracer(self, camera: Camera) -> SurfelTracer:
        """The tracer for a camera: one for all, unless surfels are turned to each."""
        if self.scene.oriented:
            return self._tracer
        position = camera.position.tobytes()
        if self._turned_to is None or self._turned_to[0] != position:
            shown = self.scene.turned_over(self._turned(camera))
            self._turned_to = position, self._tracer.with_scene(shown)
        return self._turned_to[1]

    def _turned(self, camera: Camera) -> np.ndarray:
        """(M,) bool: surfels whose other side a camera sees; a backdrop is not seen from behind."""
        away = self.scene.looks_away(camera.position)
        return away if self._backdrop is None else away & ~self._backdrop

    def surface_maps(self, camera: Camera) -> dict[str, np.ndarray]:
        """:func:`tron.shading.guidance.surface_maps` of a view: what no light changes."""
        return surface_maps(self.tracer(camera), camera)

    @property
    def transport(self) -> BounceTransport:
        """Ways of light between surfels, traced when they are first asked for.

        Raises:
            TronError: normals have no sign, and each surfel has two sides that bounce.
        """
        if isinstance(self._transport, BothSides):
            raise TronError(
                "the normals of this scene have no sign", mend="turn them first: scene.facing(point)"
            )
        return self._transport

    @cached_property
    def _transport(self) -> BounceTransport | BothSides:
        kind = BounceTransport if self.scene.oriented else BothSides
        return kind.trace(self._tracer, seed=self.seed, track=self._track)

    def prepare(self) -> Relighter:
        """Trace what does not depend on lights now rather than under the first of them; returns itself."""
        if self.estimation.bounces:
            _ = self._transport
        return self

    def under(self, light: Light, seed: int | None = None) -> Illumination:
        """Let one environment, at one turn, bounce in the scene.

        Args:
            light: an environment, or one that is prepared; this one's gradients end at the bake.
            seed: root of the shadow rays of surfels; None: the relighter's.
        """
        lighting = light if isinstance(light, Lighting) else Lighting(light)
        baked, seed = None, self.seed if seed is None else seed
        if self.estimation.bounces:
            baked = self._transport.bake(lighting, self.estimation, seed=seed)
        return Illumination(self, lighting, self.estimation, seed, baked)

    def changed(self, scene: GaussianScene) -> Relighter:
        """The relighter of another scene, which shares what stays the same; this one goes on as it is.

        Where surfels have moved or have other materials, the hierarchy is refitted and only rays that have
        changed are traced again: as if all were, to the bit. Rays are drawn in the hierarchy's order, which a
        refitted one keeps, so that what has moved has other noise than in a new ``Relighter``. Where sizes or
        opacities differ, or surfels come or go, all is made anew.

        Raises:
            TronError: another number of surfels than the backdrop has.
        """
        before = self.scene
        if self._backdrop is not None and len(scene) != len(self._backdrop):
            raise TronError("surfels have come or gone before a backdrop", mend="make a new Relighter")
        if not all(np.array_equal(getattr(scene, name), getattr(before, name)) for name in REACH):
            return Relighter(scene, self.estimation, self.seed, backdrop=self._backdrop, track=self._track)
        other = copy(self)
        other.scene, other._tracer, other._turned_to = scene, self._tracer.moved(scene), None
        traced = other.__dict__.pop("_transport", None)
        # Rays that look for moved surfels alone would find those of a backdrop too, and are not those of a
        # hierarchy that was sorted anew.
        kept = other._tracer.bvh.order is self._tracer.bvh.order and self._backdrop is None
        if traced is not None and kept:
            other.__dict__["_transport"] = traced.moved(other._tracer)
        return other


@dataclass(frozen=True)
class Illumination:
    """A scene under one light; made by :meth:`Relighter.under`.

    Attributes:
        relighter: the scene.
        lighting: the prepared environment.
        estimation: of frames: the relighter's but for what :meth:`framed` has changed.
        seed: root of the shadow rays of surfels.
    """

    relighter: Relighter
    lighting: Lighting
    estimation: Estimation
    seed: int
    _baked: BouncedLight | tuple[BouncedLight, BouncedLight] | None

    def bounced(self, camera: Camera) -> BouncedLight | None:
        """Bounced light as the tracer of a camera takes it; None where nothing bounces."""
        if isinstance(self._baked, tuple):
            return facing(*self._baked, self.relighter._turned(camera))
        return self._baked

    def turned_to(self, rotation_deg: float) -> Illumination:
        """The same environment at another rotation about +z: baked, not prepared again.

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
        """The same bake for frames of other rays a pixel: what of an :class:`Estimation` no bake knows."""
        given = {"rays": rays, "filtered": filtered, "reflections": reflections, "supersample": supersample}
        wanted: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        other = Estimation.model_validate(self.estimation.model_dump() | wanted)
        return Illumination(self.relighter, self.lighting, other, self.seed, self._baked)

    def trace(self, camera: Camera, seed: int = 0, view: GBuffer | None = None) -> TracedFrame:
        """Trace all rays of a frame; see :meth:`render`."""
        tracer, bounce = self.relighter.tracer(camera), self.bounced(camera)
        if view is None:
            (view,) = trace_views(tracer, camera, self.estimation, [bounce])
        arriving = arriving_light(tracer, view, self.lighting, self.estimation, seed, bounce)
        return TracedFrame(self.lighting, self.estimation, view, arriving)

    def render(
        self,
        camera: Camera,
        seed: int = 0,
        background: Sequence[float] | None = None,
        view: GBuffer | None = None,
    ) -> Guidance:
        """All buffers of one frame, linear.

        Args:
            camera: the view.
            seed: root of the random numbers of its rays.
            background: linear RGB radiance behind the surfels; None: the environment.
            view: what the camera sees, where it is traced already (:func:`views_under`).
        """
        return self.trace(camera, seed, view).shade(background)


@dataclass(frozen=True)
class TracedFrame:
    """A frame whose rays are traced, to be shaded before any background.

    Attributes:
        view: what the camera sees, of sub-pixels, if so.
        arriving: the light that reaches it.
    """

    lighting: Lighting
    estimation: Estimation
    view: GBuffer
    arriving: Arriving

    def shade(self, background: Sequence[float] | None = None) -> Guidance:
        """The frame; ``background`` as of :meth:`Illumination.render`."""
        return shade(self.view, self.arriving, self.lighting, background, self.estimation)


def views_under(lights: Sequence[Illumination], camera: Camera) -> list[GBuffer]:
    """What a camera sees under each of several lights of one relighter and estimation, traced once."""
    first = lights[0]
    bounces = [light.bounced(camera) for light in lights]
    return trace_views(first.relighter.tracer(camera), camera, first.estimation, bounces)
