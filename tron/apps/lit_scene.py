"""A scene ready for every camera and every light of a run: its tracers, and the light that bounces in it.

What bounces depends on the scene, traced once, and on the light and its turn, baked for each; not on the
camera. Plain 3DGS files have normals without a sign, and their surfels are turned to each camera, which takes
a tracer a camera. Where their light goes is not traced anew for each, which would take longer than the frame:
it is traced for both sides of every surfel, and each camera is shown the sides that face it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import TYPE_CHECKING

from tron.cameras import Camera
from tron.cli.progress import track
from tron.estimation import Estimation
from tron.gaussians.scene import GaussianScene
from tron.shading.both_sides import BothSides, facing
from tron.shading.bounce import BouncedLight, BounceTransport
from tron.tracing import SurfelTracer

if TYPE_CHECKING:
    from tron.shading.guidance import Lighting

Bounced = Callable[[Camera], BouncedLight | None]
"""Bounced light of one environment as the tracer of a camera takes it; None where nothing bounces."""


class LitScene:
    """Scene of a run.

    Args:
        scene: the surfels.
        first: camera that surfels whose normals have no sign are turned to before any other.
        estimation: of the light; without bounces nothing is traced for them.
        seed: root of the random numbers of bounces.
    """

    def __init__(self, scene: GaussianScene, first: Camera, estimation: Estimation, seed: int) -> None:
        self._scene = scene if scene.oriented else scene.facing(first.position)
        self._estimation, self._seed = estimation, seed
        self._last: tuple[Camera, SurfelTracer] | None = None

    def tracer(self, camera: Camera) -> SurfelTracer:
        """The tracer for a camera: one for all, unless surfels are turned to each."""
        if self._scene.oriented:
            return self._tracer
        if self._last is None or self._last[0] is not camera:
            self._last = camera, SurfelTracer(self._scene.facing(camera.position))
        return self._last[1]

    def prepare(self) -> None:
        """Trace what does not depend on lights, with a bar of its own: before another's begins."""
        if self._estimation.bounces:
            _ = self._transport if self._scene.oriented else self._both_sides

    def bake(self, lighting: Lighting) -> Bounced:
        """Let one environment, at one turn, bounce."""
        if not self._estimation.bounces:
            return lambda _: None
        if self._scene.oriented:
            baked = self._transport.bake(lighting, self._estimation, seed=self._seed)
            return lambda _: baked
        sides = self._both_sides.bake(lighting, self._estimation, self._seed)
        return lambda camera: facing(*sides, self._scene.looks_away(camera.position))

    @cached_property
    def _tracer(self) -> SurfelTracer:
        return SurfelTracer(self._scene)

    @cached_property
    def _transport(self) -> BounceTransport:
        """Ways of light through the scene, traced when they are first asked for."""
        tracer = self._tracer.sided(self._estimation.two_sided)
        return BounceTransport.trace(
            tracer, seed=self._seed, track=partial(track, label="rays of the surfels")
        )

    @cached_property
    def _both_sides(self) -> BothSides:
        return BothSides.trace(
            self._tracer, seed=self._seed, track=partial(track, label="rays of the surfels")
        )
