"""One scene of surfels in the hands of all who are to trace it; each builds its own structure when asked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mitsuba as mi

from eval.peers import embree, volprim
from eval.peers.scene import OUTSIDE, Place
from tron.gaussians.scene import GaussianScene
from tron.tracing import SurfelTracer
from tron.tracing.kernel import SurfelRecords


@dataclass
class Contenders:
    """The scene and everyone's form of it.

    Attributes:
        scene: the surfels.
        sh_degree: degree of the radiance's harmonics that the peer is given.
        shape: Mitsuba's plugin for the peer's primitives, one of ``volprim.SHAPES``.
        place: where they are, and the camera that sees them.
    """

    scene: GaussianScene
    sh_degree: int = 0
    shape: str = "ellipsoids"
    place: Place = OUTSIDE

    @property
    def label(self) -> str:
        """The number of surfels as metrics spell it."""
        return spelled(len(self.scene))

    @cached_property
    def tracer(self) -> SurfelTracer:
        """TRON's tracer, its hierarchy built."""
        return SurfelTracer(self.scene)

    @property
    def records(self) -> SurfelRecords:
        """The packed surfels, from which tile lists and hierarchies are made."""
        return self.tracer.records

    @cached_property
    def quads(self) -> mi.Scene:
        """A square around each surfel, for Mitsuba's ray queries."""
        return embree.quads(self.scene)

    @cached_property
    def primitives(self) -> mi.Scene:
        """Flat ellipsoids for ``volprim_rf_basic``."""
        return volprim.primitives(self.scene, self.sh_degree, self.shape)


def spelled(count: int) -> str:
    """10000 -> '10k', 1000000 -> '1m', 300 -> '300'.

    >>> spelled(200_000), spelled(1_000_000), spelled(1500)
    ('200k', '1m', '1500')
    """
    for size, letter in ((1_000_000, "m"), (1_000, "k")):
        if count >= size and count % size == 0:
            return f"{count // size}{letter}"
    return str(count)
