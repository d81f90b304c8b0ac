"""Patches: points that lie together, face alike and have like colour, taken as one.

Reconstructed surfaces are bumpy: normals are ten degrees wrong from one surfel to the next, and a light
fitted to them point by point is flattened until bumps that nobody photographed cost little (noise in what
explains weakens what is explained). Light that arrives is linear in the normal and in visibility, so its mean
over a patch keeps what the surfels have in common and loses their noise; so does the mean of the logarithms
of their colours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import KDTree

_MOST = 40  # points of a patch
_FACING = 0.6  # least cosine between normals of one patch


@dataclass(frozen=True, eq=False)
class Patches:
    """A patch about each of P points.

    Attributes:
        weights: (P, P) sparse, rows sum to 1.
    """

    weights: csr_array

    @classmethod
    def of(
        cls, position: np.ndarray, normal: np.ndarray, color: np.ndarray, radius: float, alike: float
    ) -> Patches:
        """Patches by place, facing and chromaticity, each weighted smoothly.

        Args:
            position, normal: (P, 3) world, normals unit.
            color: (P, 3) linear, positive.
            radius: standard deviation in space, world units; 0 leaves each point alone.
            alike: log chromaticity that points of a patch differ by.
        """
        count = len(position)
        if radius <= 0 or count < 2:
            alone = (np.ones(count, np.float32), (np.arange(count), np.arange(count)))
            return cls(csr_array(alone, shape=(count, count)))
        distance, near = map(np.asarray, KDTree(position).query(position, k=min(_MOST, count)))
        log = np.log(color)
        chroma = log[:, [0, 2]] - log[:, 1:2]
        facing = np.einsum("pkc,pc->pk", normal[near], normal)
        weight = np.exp(-0.5 * (distance / radius) ** 2) * np.clip((facing - _FACING) / (1 - _FACING), 0, 1)
        weight *= np.exp(-((chroma[near] - chroma[:, None]) ** 2).sum(-1) / alike**2)
        weight /= weight.sum(1, keepdims=True)  # each point is its own nearest, and weighs 1
        rows = np.repeat(np.arange(count), near.shape[1])
        entries = (weight.ravel().astype(np.float32), (rows, near.ravel()))
        return cls(csr_array(entries, shape=(count, count)))

    def mean(self, values: np.ndarray) -> np.ndarray:
        """(P, ...) mean of values (P, ...) over the patches."""
        columns = values.reshape(len(values), math.prod(values.shape[1:]))
        return (self.weights @ columns).reshape(values.shape)
