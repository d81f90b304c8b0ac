"""Surfels that are neighbours on one surface, and how much of them a mean about a surfel takes."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from tron.gaussians.scene import GaussianScene

_AT_ONCE = 8192


def alike_neighbours(
    scene: GaussianScene, count: int, deviation: float, agreement: float
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest surfels of each, itself first, by a Gaussian of distance, where they look the same way.

    Args:
        scene: M surfels, one at least.
        count: neighbours at most, the surfel itself among them; K of M where it has fewer.
        deviation: of the Gaussian, surfel spacings.
        agreement: cosine that the normals of two surfels lie within to count.

    Returns:
        Numbers (M, K) of the neighbours, and their weights (M, K) float32, which sum to 1.
    """
    tree, normals, count = KDTree(scene.means), scene.normals(), min(count, len(scene))
    numbers, weights = np.empty((len(scene), count), np.uint32), np.empty((len(scene), count), np.float32)
    for first in range(0, len(scene), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        found = tree.query(scene.means[part], k=count)
        distance, nearest = (np.reshape(each, (-1, count)) for each in found)
        cosine = np.einsum("mi,mki->mk", normals[part], normals[nearest])
        weight = np.exp(-0.5 * (distance / (deviation * scene.spacing)) ** 2) * (cosine > agreement)
        numbers[part], weights[part] = nearest, weight / weight.sum(axis=1, keepdims=True)
    return numbers, weights
