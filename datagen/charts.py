"""Charts: a mesh falls into parts that are seen whole from one side, and each is laid flat by looking at it.

A chart's map is piecewise affine, continuous within the chart, and shortens nowhere to less than
half. No seam needs a search: neighbours in the plane are neighbours on the surface, and what folds over
itself is divided.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

FLATTEST = 0.5
"""Least cosine of a chart's direction and its triangles' normals where a whole component is one chart."""

ANGLES = 16
"""Orientations tried for the smallest box around a chart, over a right angle."""

_AXES = np.concatenate([np.eye(3), -np.eye(3)])


@dataclass
class Charts:
    """Triangles laid flat.

    Attributes:
        chart: (F,) chart of each triangle, from 0 without a gap.
        corners: (F, 3, 2) place of its corners in the chart's plane, world units, from (0, 0).
        size: (C, 2) extent of the charts, world units.
    """

    chart: np.ndarray
    corners: np.ndarray
    size: np.ndarray


def make_charts(vertices: np.ndarray, faces: np.ndarray) -> Charts:
    """Charts of a mesh of vertices (V, 3) and faces (F, 3); its edges are where faces share two vertices."""
    normals, areas = _face_normals(vertices, faces)
    first, second = neighbours(faces)
    component = _components(len(faces), first, second)
    direction = _mean_directions(normals * areas[:, None], component)
    flat = _cosine(normals, areas, direction, component) > FLATTEST
    side = np.argmax(normals @ _AXES.T, axis=1)
    label = component * 6 + np.where(flat[component], 0, side)
    joined = label[first] == label[second]
    return flatten(vertices, faces, _components(len(faces), first[joined], second[joined]))


def flatten(vertices: np.ndarray, faces: np.ndarray, chart: np.ndarray) -> Charts:
    """Lay each chart flat along the mean of its triangles' normals, turned to fill its box."""
    normals, areas = _face_normals(vertices, faces)
    direction = _mean_directions(normals * areas[:, None], chart)
    # The mean may turn its back on a triangle at the rim; the nearest axis does not.
    axis = _AXES[np.argmax(direction @ _AXES.T, axis=1)]
    by_mean = _cosine(normals, areas, direction, chart)
    by_axis = _cosine(normals, areas, axis, chart)
    direction = np.where((by_mean >= np.minimum(by_axis, FLATTEST))[:, None], direction, axis)
    helper = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    u = np.cross(helper, direction)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(direction, u)
    corners = vertices[faces]
    plane = np.stack(
        [np.einsum("fki,fi->fk", corners, u[chart]), np.einsum("fki,fi->fk", corners, v[chart])], axis=-1
    )
    return _boxed(plane, chart)


def divided(charts: Charts, vertices: np.ndarray, faces: np.ndarray, folded: np.ndarray) -> np.ndarray:
    """Chart of each triangle (F,) where each of the ``folded`` is cut in two across its longest side."""
    centres = vertices[faces].mean(axis=1)
    chart = charts.chart.copy()
    following = len(charts.size)
    for number in folded:
        own = np.flatnonzero(charts.chart == number)
        along = centres[own][:, np.argmax(np.ptp(centres[own], axis=0))]
        far = own[np.argsort(along, kind="stable")[len(own) // 2 :]]
        chart[far] = following
        following += 1
    return chart


def neighbours(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of triangles (E,), (E,) that share an edge."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
    key = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    return order[same] // 3, order[same + 1] // 3


def _boxed(plane: np.ndarray, chart: np.ndarray) -> Charts:
    """Charts turned so that their boxes are small, moved to the origin."""
    order = np.argsort(chart, kind="stable")
    starts = np.flatnonzero(np.diff(chart[order], prepend=-1))
    points = plane[order].reshape(-1, 2)

    def box(angle: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        c, s = np.cos(angle), np.sin(angle)
        turned = np.stack([c * points[:, 0] + s * points[:, 1], c * points[:, 1] - s * points[:, 0]], axis=1)
        low = np.minimum.reduceat(turned, 3 * starts)
        return turned, low, np.maximum.reduceat(turned, 3 * starts) - low

    def areas(k: int) -> np.ndarray:
        size = box(k * np.pi / 2 / ANGLES)[2]
        return size.prod(axis=1) + 1e-9 * size.sum(axis=1)

    # To the fourth digit of the area: at equal ones the frame stays, whatever the last bits say.
    best = np.argmin(np.stack([areas(k) * (1.0 + 1e-4 * (k > 0)) for k in range(ANGLES)]), axis=0)
    lengths = np.diff(np.append(starts, len(order)))
    turned, low, size = box(np.repeat(best * (np.pi / 2 / ANGLES), 3 * lengths))
    corners = np.empty_like(plane)
    corners[order] = (turned - np.repeat(low, 3 * lengths, axis=0)).reshape(-1, 3, 2)
    return Charts(chart, corners, size)


def _face_normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (F, 3) and twice the areas (F,) of triangles; no direction, no area: zeros."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    return normals / np.maximum(areas, 1e-30)[:, None], areas


def _mean_directions(weighted: np.ndarray, group: np.ndarray) -> np.ndarray:
    total = np.stack([np.bincount(group, weighted[:, k]) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-12, total / np.maximum(length, 1e-12), (0.0, 0.0, 1.0))


def _cosine(normals: np.ndarray, areas: np.ndarray, direction: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Least cosine (G,) between a group's direction and its triangles' normals; empty ones do not count."""
    cosine = np.where(areas > 1e-12, np.einsum("fi,fi->f", normals, direction[group]), 1.0)
    least = np.full(int(group.max()) + 1, np.inf)
    np.minimum.at(least, group, cosine)
    return least


def _components(count: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    graph = coo_matrix((np.ones(len(first), np.int8), (first, second)), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)
