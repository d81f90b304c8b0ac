"""Pairs of photos that are worth matching, told by their coarsest features alone.

Comparing all features of all pairs takes most of the time of structure from motion, and most pairs of a walk
around something show nothing in common. Features of the largest scales are few and are found again from
elsewhere more often than fine ones; photos that overlap share some of them (preemptive feature matching,
Wu 2013, "Towards linear-time incremental structure from motion").
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree

_COARSEST = 250
_RATIO = 0.8  # of the distances to the nearest and the second nearest descriptor (Lowe 2004)


def coarse_descriptors(database: Path) -> dict[str, np.ndarray]:
    """Descriptors (at most 250, 128) float32 of unit length of each image's largest features, by its name.

    Args:
        database: COLMAP's, with SIFT features.
    """
    import pycolmap

    found = {}
    store = pycolmap.Database.open(database)
    try:
        for image in store.read_all_images():
            keypoints = store.read_keypoints(image.image_id)
            area = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
            largest = np.sort(np.argsort(-area, kind="stable")[:_COARSEST])
            values = store.read_descriptors(image.image_id).data[largest].astype(np.float32)
            found[image.name] = values / np.linalg.norm(values, axis=1, keepdims=True).clip(1e-6)
    finally:
        store.close()
    return found


def overlapping_pairs(descriptors: Sequence[np.ndarray], nearest: int) -> list[tuple[int, int]]:
    """Pairs (i < j) of photos, each with those ``nearest`` that share most descriptors with it.

    Pairs that connect all photos, of those that share most (the maximum spanning tree), are among them.

    Args:
        descriptors: (N, 128) of unit length, of each photo.
        nearest: photos of each; where there are hardly more, all pairs are given.
    """
    count = len(descriptors)
    if count <= nearest + 1:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    shared = np.zeros((count, count), int)
    for i in range(count):
        for j in range(i + 1, count):
            shared[i, j] = shared[j, i] = _matches(descriptors[i], descriptors[j])
    chosen = np.zeros((count, count), bool)
    ranked = shared - count * np.eye(count, dtype=int)
    best = np.argsort(-ranked, axis=1, kind="stable")[:, :nearest]
    np.put_along_axis(chosen, best, values=True, axis=1)
    chosen |= minimum_spanning_tree(1 / (1.0 + shared) * (1 - np.eye(count))).toarray() > 0
    i, j = np.nonzero(np.triu(chosen | chosen.T, 1))
    return list(zip(i.tolist(), j.tolist()))


def _matches(a: np.ndarray, b: np.ndarray) -> int:
    """Number of descriptors that are each other's nearest and stand out from the second nearest."""
    if len(a) < 2 or len(b) < 2:
        return 0
    cosine = a @ b.T
    forth, back = cosine.argmax(1), cosine.argmax(0)
    mutual = back[forth] == np.arange(len(a))
    second, first = np.partition(cosine, -2, axis=1)[:, -2:].T
    distance, next_distance = (np.arccos(np.clip(value, -1, 1)) for value in (first, second))
    return int((mutual & (distance < _RATIO * next_distance)).sum())
