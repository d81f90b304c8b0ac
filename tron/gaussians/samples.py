"""Samples of surfaces, and the grid that gathers them: a cell also tells apart objects and facings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# Fractions of a cell by which the grid is moved: with a cell boundary at 0, a flat floor at z = 0 would fall
# into two layers of cells by rounding alone.
GRID_SHIFT = np.array([0.37, 0.41, 0.43])


@dataclass
class Samples:
    """N surface samples: mean values[name] (N, C) float32 of weight (N,) pixels each, and object_id (N,)."""

    values: dict[str, np.ndarray]
    weight: np.ndarray
    object_id: np.ndarray

    def keys(self, cell: float) -> np.ndarray:
        """(N,) int64: one number for each pair of (cell, facing, object)."""
        normal = self.values["normal"]
        grid = np.floor(self.values["position"] / cell + GRID_SHIFT).astype(np.int64)
        axis = np.abs(normal).argmax(axis=1)
        facing = 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0)
        key = self.object_id
        for digit, size in ((facing, 6), *((g, np.ptp(g) + 1) for g in (grid - grid.min(axis=0)).T)):
            key = key * size + digit
        return key

    def cells(self, size: float) -> np.ndarray:
        """(N,) number of each one's cell in a grid of that size, by the order of :meth:`keys`."""
        return np.unique(self.keys(size), return_inverse=True)[1]

    def merged(self, index: np.ndarray) -> Samples:
        """One sample for each number of ``index`` (N,): weighted means, normals unit again."""
        weight = np.bincount(index, self.weight)
        owner = np.empty(len(weight), np.int64)
        owner[index] = self.object_id
        values = {}
        for name, value in self.values.items():
            sums = [np.bincount(index, self.weight * channel) for channel in value.T]
            values[name] = (np.stack(sums, axis=-1) / weight[:, None]).astype(np.float32)
        values["normal"] /= np.linalg.norm(values["normal"], axis=1, keepdims=True)
        return Samples(values, weight, owner)

    @staticmethod
    def joined(parts: Sequence[Samples]) -> Samples:
        """One of all parts, which lose their values to it, channel by channel: both never lie in memory."""
        names = list(parts[0].values)
        values = {name: np.concatenate([part.values.pop(name) for part in parts]) for name in names}
        return Samples(
            values,
            np.concatenate([part.weight for part in parts]),
            np.concatenate([part.object_id for part in parts]),
        )
