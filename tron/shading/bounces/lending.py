"""Surfels that lend each other what few rays of each have found.

A surfel of 32 shadow rays is a little noisier than a picture may be. Its neighbours on the same surface see
next to the same light, so each takes the mean of its own share and of theirs, by a Gaussian of distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import KDTree

from tron.gaussians.scene import GaussianScene
from tron.runtime import aligned

NEIGHBOURS = 8
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
        count = min(NEIGHBOURS + 1, len(scene))
        found = KDTree(scene.means).query(scene.means, k=[*range(1, count + 1)])
        distance, nearest = map(np.asarray, found)
        normals = scene.normals()
        alike = np.einsum("mi,mki->mk", normals, normals[nearest]) > AGREEMENT
        weight = alike * np.exp(-0.5 * (distance / (DEVIATION * scene.spacing)) ** 2)
        weight /= weight.sum(axis=1, keepdims=True)
        return cls(
            [mi.UInt32(aligned(each.astype(np.uint32))) for each in nearest.T],
            [mi.Float(aligned(each.astype(np.float32))) for each in weight.T],
        )

    def lent(self, values: Sequence[mi.Float]) -> list[mi.Float]:
        """(M,) means of each of the values of surfels, evaluated."""
        dr.eval(values)
        pairs = list(zip(self.lender, self.weight, strict=True))
        found = [sum((w * dr.gather(mi.Float, c, j) for j, w in pairs), mi.Float(0)) for c in values]
        dr.eval(found)
        return found
