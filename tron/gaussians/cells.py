"""Cells of surface samples, one surfel each: a grid, halved where a cell would blur most.

A surfel shows one base color and one normal. What its samples differ by is lost, and it is most of what large
frames lack. So a fifth of the surfels is kept back from the grid and spent where it saves most: again and
again the cells are halved whose halves differ most, as in a k-d tree that is built for vector quantisation
(Equitz 1989). A halved cell is no square any more, and on a slope none ever was. So a surfel is as long and
as wide as its samples are spread.
"""

from __future__ import annotations

import numpy as np

from tron.color import linear_to_srgb
from tron.gaussians.samples import Samples

GRID_SHARE = 0.8
"""Share of the surfels that are cells of the grid before any is halved."""
ROUNDS = 4
"""Rounds of halving: a cell may be halved as often."""
LEAST_SAMPLES = 6
"""A cell with fewer is not halved: its halves would have no spread to speak of."""
FLAT = 0.5
"""A cell is not halved across a side that is shorter than this share of its longest: no slivers."""
NORMAL, ROUGHNESS, METALLIC = 0.1, 0.05, 0.05
"""Weights of squared differences of normals and materials beside those of sRGB-encoded base color. A normal
that is turned by an angle changes what light shows by about a third of it, after display's curve."""
SPREAD_SAMPLES = 4
"""From so many samples on their spread says how large a surfel is; below, its neighbours' distance does."""
NARROWEST, WIDEST = 0.3, 3.0
"""Bounds of a surfel's axes over what its neighbours' distance says."""


def halved(samples: Samples, cells: np.ndarray, count: int) -> np.ndarray:
    """Cells after the halvings that take most from the squared differences within them.

    The order of the new numbers follows from the old ones and from the halves alone.

    Args:
        samples: N of a surface.
        cells: (N,) int, number of each sample's cell, from 0 without gaps.
        count: cells wanted; there are fewer where nothing is left to halve.

    Returns:
        (N,) int, numbers likewise.
    """
    number = int(cells.max()) + 1
    path = np.arange(number) << ROUNDS  # the grid's number, then a bit a round
    weight, position, shown = samples.weight, samples.values["position"].T, _shown(samples)
    for left in range(ROUNDS, 0, -1):
        wanted = -(-(count - number) // left)
        if wanted <= 0:
            break
        gain, axis, middle = _best_halves(cells, number, weight, position, shown)
        chosen = np.argsort(-gain, kind="stable")[:wanted]
        chosen = chosen[gain[chosen] > 0]
        half = np.full(number, -1)
        half[chosen] = number + np.arange(len(chosen))
        moves = np.flatnonzero(half[cells] >= 0)
        own = cells[moves]
        moves = moves[samples.values["position"][moves, axis[own]] > middle[own, axis[own]]]
        cells = cells.copy()
        cells[moves] = half[cells[moves]]
        path = np.concatenate([path, path[chosen] + (1 << (left - 1))])
        number += len(chosen)
    rank = np.empty(number, np.int64)
    rank[np.argsort(path, kind="stable")] = np.arange(number)
    return rank[cells]


def _shown(samples: Samples) -> np.ndarray:
    """(8, N) float32 of what surfels show, scaled so that squared differences have their weights."""
    values = samples.values
    weighted = [
        linear_to_srgb(np.clip(values["base_color"], 0, 1)),
        np.sqrt(NORMAL) * values["normal"],
        np.sqrt(ROUGHNESS) * values["roughness"],
        np.sqrt(METALLIC) * values["metallic"],
    ]
    return np.concatenate([np.asarray(value, np.float32).T for value in weighted])


def _best_halves(
    cells: np.ndarray, number: int, weight: np.ndarray, position: np.ndarray, shown: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What halving each cell at its middle takes from its squared differences, across which axis, and where.

    Returns:
        (C,) float64, 0 where it cannot be halved; (C,) int axis; (C, 3) middles, world units.
    """

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(cells, values, number)

    whole = total(weight)
    middle = np.stack([total(weight * p) / whole for p in position], axis=-1)
    spread = np.stack(
        [total(weight * (p - m[cells]) ** 2) / whole for p, m in zip(position, middle.T)], axis=-1
    )
    wide = spread >= FLAT**2 * spread.max(axis=1, keepdims=True)
    wide &= (np.bincount(cells, minlength=number) >= LEAST_SAMPLES)[:, None]
    sums = [total(weight * value) for value in shown]
    gains = np.zeros((number, 3))
    for k in range(3):
        upper = weight * (position[k] > middle[cells, k])
        high = total(upper)
        low = whole - high
        sound = wide[:, k] & (high > 0) & (low > 0)
        # Between the halves: w0 w1 / w of the squared distance of their means.
        scale = np.where(sound, whole / np.where(sound, high * low, 1), 0)
        for value, both in zip(shown, sums):
            gains[:, k] += scale * (total(upper * value) - both * high / whole) ** 2
    axis = gains.argmax(axis=1)
    return gains.max(axis=1), axis, middle


def axes(
    samples: Samples, cells: np.ndarray, merged: Samples, distances: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sides of a rectangle spread as the samples of each cell are in its tangent plane, and their frame.

    Args:
        samples: N of a surface. cells: (N,) number of each one's cell.
        merged: the M cells' means.
        distances: (M,) to the neighbours, which bound the sides and stand in where samples are few.

    Returns:
        (M, 3, 3) float64 rotations, whose columns are the long side, the short one and the normal; (M, 2)
        float64 lengths of the two sides, world units.
    """
    number = len(merged.weight)
    normal = merged.values["normal"].astype(np.float64)
    frame = np.stack(_tangents(normal), axis=1)
    offset = samples.values["position"] - merged.values["position"].astype(np.float64)[cells]
    u, v = (np.einsum("nc,nc->n", offset, tangent[cells]) for tangent in frame.transpose(1, 0, 2))
    held = np.bincount(cells, minlength=number)
    # Unbiased: four samples in a square of pixels are spread as the square is.
    unbiased = held / np.maximum(held - 1, 1) / merged.weight
    uu, uv, vv = (
        np.bincount(cells, samples.weight * product, number) * unbiased for product in (u * u, u * v, v * v)
    )
    variance, turn = np.linalg.eigh(np.stack([uu, uv, uv, vv], axis=-1).reshape(-1, 2, 2))
    few = held < SPREAD_SAMPLES
    sides = np.sqrt(12 * np.maximum(variance[:, ::-1], 0))
    sides = np.where(few[:, None], 1, np.clip(sides / distances[:, None], NARROWEST, WIDEST))
    long = np.einsum("mk,mkc->mc", turn[:, :, 1], frame)
    return np.stack([long, np.cross(normal, long), normal], axis=-1), sides * distances[:, None]


def _tangents(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (M, 3) that make right-handed frames with unit normals (M, 3)."""
    away = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = np.cross(away, normal)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normal, first)
