"""Shadows: the rest of a photo's shading after light by direction, by Land's and Horn's rule.

Land and McCann 1971 ("Lightness and Retinex Theory") and Horn 1974 ("Determining Lightness from an Image"):
reflectance changes abruptly, illumination gently. Colour helps: a shadow darkens, another material also
changes chromaticity. Each difference g = l_p - l_q of log luminance between neighbours is therefore split,
and the log shading t solves Horn's Poisson equation in the least-squares sense,

    min_t  sum_pq w_pq (t_p - t_q - h_pq g_pq)^2 + screening sum_p (t_p - guess_p)^2,
    h_pq = exp(-(dchroma_pq / chroma_edge)^2 - (g_pq / edge)^2),

where h is near one for gentle grey changes and near zero for reflectance edges. Neighbours on different
surfaces (w = 0) tell nothing. The guess ties together what no path of pixels joins.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

_TOLERANCE = 1e-4
_ITERATIONS = 400
_SAME_SURFACE = 0.7  # cosine between neighbouring pixels' normals


def residual_shading(
    log_luminance: np.ndarray,
    chroma: np.ndarray,
    normals: np.ndarray,
    surface: np.ndarray,
    edge: float,
    chroma_edge: float,
    guess: np.ndarray,
    screening: float,
) -> np.ndarray:
    """Split log luminance into a shading, which is returned, and a reflectance, the rest.

    Args:
        log_luminance: (H, W) natural logarithm, directional shading already subtracted.
        chroma: (H, W, 2) log chromaticity.
        normals: (H, W, 3) unit; neighbours that face apart are on different surfaces.
        surface: (H, W) bool; only these pixels are read.
        edge: log difference of luminance from which on a change is reflectance.
        chroma_edge: log difference of chromaticity, likewise.
        guess: (H, W) log shading where nothing else is known.
        screening: pull towards the guess; it wins over distances beyond 1 / sqrt(screening) pixels.

    Returns:
        (H, W) float64, zero off the surface.
    """
    height, width = surface.shape
    index = np.arange(height * width).reshape(height, width)
    size = height * width
    diagonal = np.full(size, screening)
    divergence = screening * np.where(surface, guess, 0.0).ravel()
    rows, columns, values = [], [], []
    for a, b in (
        ((slice(None), slice(0, -1)), (slice(None), slice(1, None))),
        ((slice(0, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        joined = surface[a] & surface[b] & ((normals[a] * normals[b]).sum(-1) > _SAME_SURFACE)
        p, q = index[a][joined], index[b][joined]
        g = (log_luminance[a] - log_luminance[b])[joined]
        dchroma = np.linalg.norm(chroma[a] - chroma[b], axis=-1)[joined]
        g = g * np.exp(-((dchroma / chroma_edge) ** 2) - (g / edge) ** 2)
        for end, sign in ((p, 1.0), (q, -1.0)):
            divergence += np.bincount(end, sign * g, size)
            diagonal += np.bincount(end, minlength=size)
        rows += [p, q]
        columns += [q, p]
        values += [-np.ones(len(p))] * 2
    laplacian = coo_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(size, size)
    )
    matrix = (laplacian + diags_array(diagonal)).tocsr()
    solved, _ = cg(matrix, divergence, rtol=_TOLERANCE, maxiter=_ITERATIONS, M=diags_array(1 / diagonal))
    return np.where(surface, solved.reshape(height, width), 0.0)
