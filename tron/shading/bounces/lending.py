"""Surfels that lend each other what few rays of each have found.

A surfel of 32 shadow rays is a little noisier than a picture may be. Its neighbours on the same surface see
next to the same light, so each takes the mean of its own share and of theirs, by a Gaussian of distance.
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
"""Of a surfel, itself among them."""
DEVIATION = 0.8
"""Of the Gaussian, in spacings."""
AGREEMENT = 0.7
"""Least cosine between normals of surfels that lend."""


@dataclass(frozen=True)
class Lending:
    """The neighbours of M surfels and their weights, which sum to 1 with the surfel's own."""

    lender: list[mi.UInt32]
    weight: list[mi.Float]

    @classmethod
    def among(cls, scene: GaussianScene) -> Lending:
        """The nearest of each surfel, itself among them: 0.2 seconds for 50,000 on one core."""
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
