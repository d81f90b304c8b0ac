"""One scene of surfels in the hands of all who are to trace it; each builds its own structure when asked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import mitsuba as mi

from eval.peers import embree, gsplat, volprim
from eval.peers.scene import OUTSIDE, STUDY, Place, Recipe, surfels
from tron.cameras import Camera
from tron.gaussians.scene import GaussianScene
from tron.tracing import SurfelTracer


@dataclass
class Contenders:
    """The scene and everyone's form of it.

    Attributes:
        scene: the surfels.
        recipe: how they were made; the peers are given harmonics of its degree.
        place: where they are, and the camera that sees them.
        shape: Mitsuba's plugin for the peer's primitives, one of ``volprim.SHAPES``.
    """

    scene: GaussianScene
    recipe: Recipe = STUDY
    place: Place = OUTSIDE
    shape: str = "ellipsoids"

    @classmethod
    def of(cls, count: int, seed: int, recipe: Recipe = STUDY, place: Place = OUTSIDE) -> Contenders:
        """Contenders for ``count`` drawn surfels."""
        return cls(surfels(count, seed, recipe, place), recipe, place)

    @cached_property
    def tracer(self) -> SurfelTracer:
        """TRON's tracer, its hierarchy built."""
        return SurfelTracer(self.scene)

    @cached_property
    def quads(self) -> mi.Scene:
        """A square around each surfel, for Mitsuba's ray queries."""
        return embree.quads(self.scene)

    @cached_property
    def primitives(self) -> mi.Scene:
        """Flat ellipsoids for ``volprim_rf_basic``."""
        return volprim.primitives(self.scene, self.recipe.sh_degree, self.shape)


class Peer(Protocol):
    """A renderer whose frames are timed beside TRON's.

    Attributes:
        name: in the names of metrics.
        title: on pages.
    """

    @property
    def name(self) -> str: ...

    @property
    def title(self) -> str: ...

    def frame(self, contenders: Contenders, view: Camera) -> Callable[[], Any] | None:
        """A call that renders one frame, its structure built before; None where the peer cannot run."""


@dataclass(frozen=True)
class Volprim:
    """Mitsuba's ``volprim_rf_basic``; ``stop`` is the transmittance below which it ends a ray."""

    name: str
    title: str
    stop: float

    def frame(self, contenders: Contenders, view: Camera) -> Callable[[], Any]:
        """One ray a pixel, somewhere in the pixel, as a user renders it."""
        scene, sensor = contenders.primitives, volprim.sensor(view)
        integrator = volprim.load_integrator(self.stop)
        return lambda: volprim.render(scene, sensor, integrator)


class ClosestHit:
    """One ray query a pixel: no opacity, no order, no colour."""

    name, title = "embree_closest_hit", "one closest hit"

    def frame(self, contenders: Contenders, view: Camera) -> Callable[[], Any]:
        """Rays through the pixel centres, tile after tile."""
        scene, (origin, direction) = contenders.quads, embree.tile_rays(view)
        return lambda: embree.closest_hit(scene, origin, direction, coherent=True)


class Gsplat:
    """The rasteriser of 2D Gaussians of gsplat, harmonics of degree 0."""

    name, title = "gsplat", "gsplat 2DGS"

    def frame(self, contenders: Contenders, view: Camera) -> Callable[[], Any] | None:
        """One frame, until the device has finished."""
        return gsplat.renderer(contenders.scene, view) if gsplat.available() else None


SHIPPED = "volprim_as_shipped"
PEERS: tuple[Peer, ...] = (
    Volprim("volprim", "volprim_rf_basic", volprim.OUR_STOP),
    Volprim(SHIPPED, "volprim_rf_basic as shipped", volprim.SHIPPED_STOP),
    ClosestHit(),
    Gsplat(),
)
"""In the order of the tables. A new peer is a class with a ``frame``, and an entry here."""
