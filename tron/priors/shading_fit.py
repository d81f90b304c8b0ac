"""Light by surface direction: one degree-2 irradiance for all views, fitted to the photos' luminance.

Irradiance without shadows is a function of the normal alone, and degree-2 harmonics hold 99% of it
(Ramamoorthi and Hanrahan 2001, "An Efficient Representation for Irradiance Environment Maps"). Reflectance is
not known, but surfaces of one chromaticity are mostly of one material: with an unknown offset a_k for each of
K chromaticities, log luminance is

    log I(p) = a_k(p) + log S(n(p)),    log S = sum_i c_i Y_i,  i = 1..8,

which is linear in all unknowns: the light is read off from how surfaces of *one* chromaticity darken as they
turn, whatever their albedos are. The logarithm of S, rather than S, is expanded, so that S is positive.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial import KDTree

from tron.gaussians.harmonics import sh_matrix
from tron.seeds import generator

TERMS = 9
"""Harmonics of degree 0 to 2; the first is the scale, which belongs to the reflectance."""

_HUBER = 0.2  # log units beyond which shadows and highlights lose their say
_ROUNDS = 15
_PULL = 1e-3  # towards uniform light, of directions that nobody sees
_CLUSTERING = 20  # rounds of k-means
_DIGITS = 2  # of log chromaticity that tell colours apart
_CELLS = 4  # a side of the cube on which normals are counted, a face


@dataclass(frozen=True, eq=False)
class Shading:
    """Light by direction and reflectance by colour, which all views share.

    Attributes:
        coefficients: (9,) of log S, the log of irradiance by normal, up to scale, in sh_matrix's first terms.
        centres: (K, 2) log chromaticities of the groups.
        offsets: (K,) log reflectance of each, the median of log I - log S.
    """

    coefficients: np.ndarray
    centres: np.ndarray
    offsets: np.ndarray

    def log(self, normals: np.ndarray) -> np.ndarray:
        """log S of (..., 3) unit world normals -> (...) float64."""
        return sh_matrix(normals)[..., :TERMS] @ self.coefficients

    def log_reflectance(self, chroma: np.ndarray) -> np.ndarray:
        """(..., 2) log chromaticities -> (...) what surfaces like that reflect, by the nearest group."""
        return self.offsets[_nearest(chroma, self.centres)]


def chromaticity(rgb: np.ndarray) -> np.ndarray:
    """(..., 3) positive linear RGB -> (..., 2) log R/G and B/G, which shading by grey light leaves alone."""
    logs = np.log(rgb)
    return logs[..., (0, 2)] - logs[..., 1:2]


def fit_shading(
    chroma: np.ndarray, normals: np.ndarray, log_luminance: np.ndarray, groups: int, seed: int
) -> Shading:
    """Fit the harmonics by iterated least squares with Huber's weights.

    Directions that many pixels face, such as a floor's, would drown the others: a pixel is weighted by one
    over the square root of the number that face its way.

    Args:
        chroma: (N, 2) log chromaticities of surface points of all views.
        normals: (N, 3) unit, world.
        log_luminance: (N,) natural logarithm of their luminance.
        groups: K, the most chromaticities that are told apart.
        seed: root of their clustering.
    """
    # k-means cannot tell apart more colours than there are.
    groups = min(groups, len(np.unique(chroma.round(_DIGITS), axis=0)))
    draw = generator(seed, "prior", "classical", "chromaticity")
    centres, _ = kmeans2(chroma, groups, iter=_CLUSTERING, minit="++", rng=draw)
    group = _nearest(chroma, centres)
    basis = sh_matrix(normals)[:, 1:TERMS]
    importance = 1 / np.sqrt(_crowding(normals))
    weight = importance
    harmonics = np.zeros(TERMS - 1)
    for _ in range(_ROUNDS):
        # Subtracting each group's weighted mean eliminates the offsets (Frisch, Waugh and Lovell).
        x, y = _centred(basis, group, weight), _centred(log_luminance[:, None], group, weight)[:, 0]
        normal_matrix = x.T @ (weight[:, None] * x) + _PULL * weight.sum() * np.eye(TERMS - 1)
        harmonics = np.linalg.solve(normal_matrix, x.T @ (weight * y))
        residual = np.abs(y - x @ harmonics)
        weight = importance * np.minimum(1, _HUBER / np.maximum(residual, 1e-12))
    log_shading = basis @ harmonics
    rest = log_luminance - log_shading
    offsets = [
        np.median(rest[group == k]) if (group == k).any() else np.median(rest) for k in range(len(centres))
    ]
    return Shading(np.concatenate([[0.0], harmonics]), centres, np.array(offsets))


def _nearest(chroma: np.ndarray, centres: np.ndarray) -> np.ndarray:
    return np.asarray(KDTree(centres).query(chroma)[1])


def _centred(values: np.ndarray, group: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(N, C) minus the weighted mean of each point's group."""
    total = np.maximum(np.bincount(group, weight), 1e-12)
    sums = np.stack([np.bincount(group, weight * column) for column in values.T], axis=1)
    return values - (sums / total[:, None])[group]


def _crowding(normals: np.ndarray) -> np.ndarray:
    """(N,) how many of the normals fall into the same cell of a cube around the origin."""
    axis = np.abs(normals).argmax(axis=1)
    rows = np.arange(len(normals))
    major = normals[rows, axis]
    face = 2 * axis + (major > 0)
    minor = np.stack([normals[rows, (axis + 1) % 3], normals[rows, (axis + 2) % 3]], axis=1)
    cell = ((minor / np.abs(major)[:, None] + 1) / 2 * _CELLS).astype(int).clip(0, _CELLS - 1)
    index = (face * _CELLS + cell[:, 0]) * _CELLS + cell[:, 1]
    return np.bincount(index)[index]
