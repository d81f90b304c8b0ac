"""Sums over lat-long images, taken as the bilinear function between their samples.

Columns are centred on half texels and wrap around; rows stand on the poles.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from scipy import sparse


def row_integrals(height: int, density: Any) -> np.ndarray:
    """(H,) integral over theta in [0, pi] of each row's hat times ``density(theta)``, by Gauss-Legendre."""
    node, weight = np.polynomial.legendre.leggauss(8)
    node, weight = 0.5 * (node + 1), 0.5 * weight
    step = np.pi / (height - 1)
    # Each interval between rows is halved, so that the horizon, a kink of cosines, is always an end point.
    total = np.zeros(height)
    for half in (0.0, 0.5):
        inner = half + 0.5 * node
        theta = (np.arange(height - 1)[:, None] + inner) * step
        value = density(theta) * weight * 0.5 * step
        total[:-1] += (value * (1 - inner)).sum(1)
        total[1:] += (value * inner).sum(1)
    return total


def directions(height: int, width: int, rows: slice = slice(None)) -> np.ndarray:
    """(H, W, 3) float64 unit directions of the samples, or of some ``rows``, of a lat-long image."""
    polar = np.arange(height)[rows, None] * np.pi / (height - 1)
    around = (np.arange(width) + 0.5)[None] * 2 * np.pi / width
    across = np.sin(polar)
    axes = np.broadcast_arrays(across * np.sin(around), across * np.cos(around), np.cos(polar))
    return np.stack(axes, axis=-1)


def resampled(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """(height, width, 3) float32, not negative, of (H, W, 3); rows stand on the poles before and after.

    Lights do not move, and a constant stays constant.
    """
    rows = _row_average(image.shape[0], height)
    columns = _column_average(image.shape[1], width)
    wide = np.asarray(image, np.float64)
    wide = (rows @ wide.reshape(len(wide), -1)).reshape(height, -1, 3)
    wide = (columns @ wide.transpose(1, 0, 2).reshape(wide.shape[1], -1)).reshape(width, height, 3)
    return np.maximum(wide.transpose(1, 0, 2), 0).astype(np.float32)


def _average(edges: np.ndarray, size: int, offset: float, density: Any) -> sparse.csr_matrix:
    """Rows are the averages of a hat basis over [edges[i], edges[i + 1]], weighted by ``density``.

    Basis function j has its peak at ``offset`` + j, in source texels; ``edges`` are in source texels too.
    Indices wrap around modulo ``size``.
    """
    lower, upper = edges[:-1], edges[1:]
    pieces = int(np.ceil((upper - lower).max())) + 1
    node, weight = np.polynomial.legendre.leggauss(4)
    row, column, value = [], [], []
    for k in range(pieces):
        # Piece k of a cell lies between two neighbouring peaks, where the hats are linear.
        start = np.floor(lower - offset) + offset + k
        a, b = np.clip(start, lower, upper), np.clip(start + 1, lower, upper)
        x = a[:, None] + (b - a)[:, None] * 0.5 * (node + 1)
        w = density(x) * weight * (b - a)[:, None]
        left = np.floor(start - offset + 0.5).astype(int)
        part = x - start[:, None]
        for shift, share in ((0, (w * (1 - part)).sum(1)), (1, (w * part).sum(1))):
            row.append(np.arange(len(lower)))
            column.append((left + shift) % size)
            value.append(share)
    shape = (len(lower), size)
    entries = np.concatenate(value), (np.concatenate(row), np.concatenate(column))
    from scipy import sparse

    matrix = sparse.coo_matrix(entries, shape).tocsr()
    return sparse.diags(1 / np.asarray(matrix.sum(1)).ravel()) @ matrix


def _row_average(source: int, target: int) -> sparse.csr_matrix:
    ratio = (source - 1) / (target - 1)
    edges = np.clip(np.arange(target + 1) - 0.5, 0, target - 1) * ratio
    return _average(edges, source, 0.0, lambda y: np.sin(y * np.pi / (source - 1)))


def _column_average(source: int, target: int) -> sparse.csr_matrix:
    return _average(np.arange(target + 1) * (source / target), source, 0.5, np.ones_like)
