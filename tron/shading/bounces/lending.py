"""Filter of per-surfel light: neighbouring surfels share the results of their few rays.

With 32 shadow rays, a surfel is slightly too noisy for a picture. Its neighbours on the same surface see
nearly the same light, so their shares are averaged, weighted by a Gaussian of distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from tron.gaussians.neighbours import alike_neighbours
from tron.gaussians.scene import GaussianScene
from tron.runtime import aligned

NEIGHBOURS = 9
"""Number of neighbours averaged, the surfel itself included."""
DEVIATION = 0.8
"""Standard deviation of the Gaussian, in spacings."""
AGREEMENT = 0.7
"""Least cosine between the normals of surfels that are averaged."""


@dataclass(frozen=True)
class Lending:
    """The neighbours of M surfels and their weights, which sum to 1 with the surfel's own."""

    lender: list[mi.UInt32]
    weight: list[mi.Float]

    @classmethod
    def among(cls, scene: GaussianScene) -> Lending:
        """Find each surfel's nearest neighbours, itself included: 0.2 seconds for 50,000 on one core."""
        numbers, weights = alike_neighbours(scene, NEIGHBOURS, DEVIATION, AGREEMENT)
        return cls(
            [mi.UInt32(aligned(each)) for each in numbers.T], [mi.Float(aligned(each)) for each in weights.T]
        )

    def lent(self, values: Sequence[mi.Float]) -> list[mi.Float]:
        """(M,) means of each of the values of surfels, evaluated."""
        dr.eval(values)
        pairs = list(zip(self.lender, self.weight, strict=True))
        found = [sum((w * dr.gather(mi.Float, c, j) for j, w in pairs), mi.Float(0)) for c in values]
        dr.eval(found)
        return found
