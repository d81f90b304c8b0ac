"""One texture for all pieces of a scene: materials evaluated texel by texel and packed into an atlas.

A mesh falls into charts that are seen whole from one side, and each is laid flat by looking at it: the map is
piecewise affine, continuous within the chart, and shortens nowhere to less than half. No seam needs a search:
neighbours in the plane are neighbours on the surface, and what folds over itself is divided.

Each chart has a rectangle in the atlas. A texel that any bilinear lookup on a
triangle touches is evaluated at its own point of the surface, beyond the rim on the triangle's plane: none is
smeared from another, and both sides of a seam read the same material. Relief becomes a tangent-space normal
map in the frame of Mitsuba's ``normalmap``: s is dp/du made orthogonal to the shading normal, t is n x s.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from datagen.world.materials.material import Evaluated

log = logging.getLogger(__name__)

MOST_TEXELS = 2**22
"""Texels of an atlas at most. A scene that needs more has fewer a unit."""

ROUNDS = 8
"""Times that charts which fold over themselves are divided; what still does is taken apart."""

FOLD = 0.1
"""Depth in texels to which the centre of a texel lies inside two triangles where a chart is folded."""

FLATTEST = 0.5
"""Least cosine of a chart's direction and its triangles' normals where a whole component is one chart."""

ANGLES = 16
"""Orientations tried for the smallest box around a chart, over a right angle."""

_AXES = np.concatenate([np.eye(3), -np.eye(3)])


class Surface(NamedTuple):
    """Triangles of one material.

    Attributes:
        vertices, normals: (V, 3) the object's frame; unit shading normals.
        faces: (F, 3) int.
        material: what they are made of.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    material: Evaluated


@dataclass
class Atlas:
    """Textures (H, W, C) float32, linear, top row first, and how surfaces lie in them.

    Attributes:
        base_color, roughness, metallic: of :mod:`tron.brdf`.
        normal_map: tangent-space normals as (n + 1) / 2.
        laid: for each surface its vertices, once for each chart: index (V',) of the vertex that it is, uv
            (V', 2), faces (F, 3).
        texels_per_unit: density that was reached.
    """

    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    normal_map: np.ndarray
    laid: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    texels_per_unit: float


def bake(surfaces: Sequence[Surface], texels_per_unit: float, most: int = MOST_TEXELS) -> Atlas:
    """Bake materials into an atlas.

    Args:
        surfaces: what the scene is made of.
        texels_per_unit: texels a world unit, along the charts' planes.
        most: texels of all charts; if there would be more, ``texels_per_unit`` falls, and the log says so.
    """
    charts = [make_charts(surface.vertices, surface.faces) for surface in surfaces]
    density = _density(charts, texels_per_unit, most)
    found = [_unfolded(each, surface, density) for each, surface in zip(charts, surfaces)]
    sizes = [_texels(each, density) for each, _ in found]
    places, (height, width) = pack(np.concatenate(sizes))
    images = [np.zeros((height * width, channels), np.float32) for channels in (3, 1, 1, 3)]
    images[3][:] = (0.5, 0.5, 1.0)
    first, laid = 0, []
    for surface, (chart, texels), size in zip(surfaces, found, sizes):
        place = places[first : first + len(size)]
        first += len(size)
        at = (texels.y + place[texels.chart, 1]) * width + texels.x + place[texels.chart, 0]
        for image, values in zip(images, _evaluate(surface, chart, size, texels, density)):
            image[at] = values
        corners = chart.corners * density + 1.0 + place[chart.chart][:, None]
        laid.append(_split(surface.faces, chart.chart, corners / (width, height)))
    color, rough, metal, normal = (image.reshape(height, width, -1) for image in images)
    return Atlas(color, rough, metal, normal, laid, density)


def pack(sizes: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """Pack rectangles (C, 2) int, width and height, on shelves; return places (C, 2), height and width."""
    width = max(int(np.sqrt(1.1 * sizes.prod(axis=1).sum())) + 1, int(sizes[:, 0].max()))
    places = np.zeros_like(sizes)
    x = y = shelf = 0
    order = np.lexsort((sizes[:, 0], sizes[:, 1]))[::-1]
    for index, (w, h) in zip(order.tolist(), sizes[order].tolist()):
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        places[index] = x, y
        x, shelf = x + w, max(shelf, h)
    return places, (y + shelf, width)


class _Texels(NamedTuple):
    """Texels that lookups touch: chart, place in it, triangle and its barycentric coordinates (N, 3)."""

    chart: np.ndarray
    x: np.ndarray
    y: np.ndarray
    face: np.ndarray
    weights: np.ndarray


def _density(charts: Sequence[Charts], texels_per_unit: float, most: int) -> float:
    density = texels_per_unit
    for _ in range(40):
        total = sum(int(_texels(each, density).prod(axis=1).sum()) for each in charts)
        if total <= most:
            break
        density *= min(np.sqrt(most / total), 0.98)
    if density < texels_per_unit:
        log.warning(
            "the scene's surfaces are large: %.0f texels a unit instead of %.0f", density, texels_per_unit
        )
    return density


def _texels(charts: Charts, density: float) -> np.ndarray:
    """Width and height (C, 2) int of the charts in texels, one around for lookups at the rim."""
    return np.ceil(charts.size * density - 1e-6).astype(np.int64) + 2


def _unfolded(charts: Charts, surface: Surface, density: float) -> tuple[Charts, _Texels]:
    """Return charts that cover no texel twice, and their texels."""
    for attempt in range(ROUNDS):
        texels, folded = _rasterise(charts, density)
        if not len(folded):
            break
        if attempt == ROUNDS - 2:
            alone = np.isin(charts.chart, folded)
            chart = np.where(alone, len(charts.size) + np.arange(len(charts.chart)), charts.chart)
        else:
            chart = divided(charts, surface.vertices, surface.faces, folded)
        charts = flatten(surface.vertices, surface.faces, np.unique(chart, return_inverse=True)[1])
    return charts, texels


class _Pairs(NamedTuple):
    """Triangles and the texels of their charts near them: face, x, y (P,)."""

    face: np.ndarray
    x: np.ndarray
    y: np.ndarray


def _pairs(charts: Charts, density: float) -> _Pairs:
    """Texels whose centres are less than one in x and y from a triangle, row by row."""
    corners = charts.corners * density + 1.0
    low, high = corners[..., 1].min(axis=1), corners[..., 1].max(axis=1)
    top = np.ceil(low - 1.5).astype(np.int64)
    rows = np.floor(high + 0.5).astype(np.int64) - top + 1
    face, row = _ranges(np.maximum(rows, 0))
    y = top[face] + row
    # Each edge, cut to the slab of rows within one, bounds the x that this row needs.
    a = corners[face]
    b = np.roll(a, -1, axis=1)
    rise = b[..., 1] - a[..., 1]
    safe = np.where(np.abs(rise) > 1e-12, rise, 1e-12)
    cuts = np.sort(np.stack([(y[:, None] + 0.5 + s - a[..., 1]) / safe for s in (-1, 1)]), axis=0)
    enters, leaves = np.clip(cuts, 0.0, 1.0)
    run = b[..., 0] - a[..., 0]
    ends = np.stack([a[..., 0] + enters * run, a[..., 0] + leaves * run])
    missed = (cuts[0] > 1.0) | (cuts[1] < 0.0)
    left = np.where(missed, np.inf, ends.min(axis=0)).min(axis=1)
    right = np.where(missed, -np.inf, ends.max(axis=0)).max(axis=1)
    met = left <= right
    face, y, left, right = face[met], y[met], left[met], right[met]
    start = np.ceil(left - 1.5).astype(np.int64)
    index, step = _ranges(np.maximum(np.floor(right + 0.5).astype(np.int64) - start + 1, 0))
    return _Pairs(face[index], start[index] + step, y[index])


def _depths(charts: Charts, density: float, pairs: _Pairs) -> tuple[np.ndarray, np.ndarray]:
    """Depth of each texel's centre inside its triangle, in texels (P,), and its weights (P, 3)."""
    corners = charts.corners * density + 1.0
    a, b, c = (corners[:, k] for k in range(3))
    twice = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    twice = np.where(np.abs(twice) > 1e-12, twice, 1e-12)
    px, py = pairs.x + 0.5, pairs.y + 0.5
    weights, depth = [], np.full(len(px), np.inf)
    for p, q in ((b, c), (c, a), (a, b)):
        gx, gy = (p - q)[:, 1] / twice, (q - p)[:, 0] / twice
        at = -(gx * p[:, 0] + gy * p[:, 1])
        weight = gx[pairs.face] * px + gy[pairs.face] * py + at[pairs.face]
        weights.append(weight)
        depth = np.minimum(depth, weight / np.maximum(np.hypot(gx, gy), 1e-12)[pairs.face])
    return depth, np.stack(weights, axis=1)


def _rasterise(charts: Charts, density: float) -> tuple[_Texels, np.ndarray]:
    """Assign each texel within reach of a lookup to its triangle or the nearest one; find folded charts."""
    size = _texels(charts, density)
    pairs = _pairs(charts, density)
    depth, weights = _depths(charts, density, pairs)
    area = size.prod(axis=1)
    chart = charts.chart[pairs.face]
    texel = (np.cumsum(area) - area)[chart] + pairs.y * size[chart, 0] + pairs.x
    owner = np.full(int(area.sum()), -1, np.int64)
    outside = np.flatnonzero(depth < 0.0)
    outside = outside[np.argsort(depth[outside], kind="stable")]
    owner[texel[outside]] = outside
    inside = np.flatnonzero(depth >= 0.0)
    owner[texel[inside]] = inside
    deep = np.flatnonzero(depth > FOLD)
    folded = np.unique(chart[deep[owner[texel[deep]] != deep]])
    chosen = owner[owner >= 0]
    return _Texels(
        chart[chosen], pairs.x[chosen], pairs.y[chosen], pairs.face[chosen], weights[chosen]
    ), folded


def _evaluate(
    surface: Surface, charts: Charts, size: np.ndarray, texels: _Texels, density: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Base color (N, 3), roughness (N, 1), metallic (N, 1) and encoded normals (N, 3) of texels."""
    corner = surface.faces[texels.face]
    points = np.einsum("nk,nki->ni", texels.weights, surface.vertices[corner])
    normals = np.einsum("nk,nki->ni", texels.weights, surface.normals[corner])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-9, normals / np.maximum(length, 1e-9), surface.normals[corner[:, 0]])
    seen = surface.material.evaluate(points, normals)
    bent = np.tile((0.5, 0.5, 1.0), (len(points), 1))
    if np.ptp(seen.height) > 0.0:
        slopes = _slopes(seen.height, size, texels, density)
        bent = 0.5 + 0.5 * _bend(normals, *_tangents(surface, charts), texels.face, slopes)
    return seen.base_color, seen.roughness[:, None], seen.metallic[:, None], bent.astype(np.float32)


def _slopes(height: np.ndarray, size: np.ndarray, texels: _Texels, density: float) -> np.ndarray:
    """Derivatives (N, 2) of the height along the chart's axes, by second-order differences."""
    area = size.prod(axis=1)
    # Two more on all sides, so that what lies beyond a chart is never another's.
    wide = size[:, 0] + 4
    room = wide * (size[:, 1] + 4)
    field = np.full(int(room.sum()), np.nan, np.float64)
    at = (np.cumsum(room) - room)[texels.chart] + (texels.y + 2) * wide[texels.chart] + texels.x + 2
    field[at] = height
    slopes = []
    for step in (np.ones_like(area), wide):
        step = step[texels.chart]
        back, ahead = field[at - step], field[at + step]
        central = 0.5 * (ahead - back)
        forward = 2.0 * ahead - 1.5 * height - 0.5 * field[at + 2 * step]
        backward = 1.5 * height - 2.0 * back + 0.5 * field[at - 2 * step]
        found = central
        for other in (forward, backward, ahead - height, height - back):
            found = np.where(np.isnan(found), other, found)
        slopes.append(np.nan_to_num(found) * density)
    return np.stack(slopes, axis=1)


def _tangents(surface: Surface, charts: Charts) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (F, 3) of the surface's points along the chart's axes."""
    corners, plane = surface.vertices[surface.faces], charts.corners
    edges = corners[:, 1:] - corners[:, :1]
    (a, b), (c, d) = np.moveaxis(plane[:, 1:] - plane[:, :1], 0, -1)
    twice = a * d - b * c
    twice = np.where(np.abs(twice) > 1e-20, twice, np.inf)[:, None]
    u = (d[:, None] * edges[:, 0] - b[:, None] * edges[:, 1]) / twice
    v = (a[:, None] * edges[:, 1] - c[:, None] * edges[:, 0]) / twice
    return u, v


def _bend(
    normals: np.ndarray, u: np.ndarray, v: np.ndarray, face: np.ndarray, slopes: np.ndarray
) -> np.ndarray:
    """Unit normals (N, 3) of the relief in the frame of Mitsuba's ``normalmap``.

    The gradient along the surface is that of Mikkelsen, "Bump mapping unparametrized surfaces on the GPU"
    (2010).
    """
    u, v = u[face], v[face]
    across, up = np.cross(v, normals), np.cross(normals, u)
    volume = np.einsum("ni,ni->n", u, across)
    safe = np.where(np.abs(volume) > 1e-12, volume, np.inf)[:, None]
    gradient = (slopes[:, :1] * across + slopes[:, 1:] * up) / safe
    s = u - normals * np.einsum("ni,ni->n", u, normals)[:, None]
    s /= np.maximum(np.linalg.norm(s, axis=1, keepdims=True), 1e-12)
    t = np.cross(normals, s)
    bent = np.stack(
        [-np.einsum("ni,ni->n", gradient, s), -np.einsum("ni,ni->n", gradient, t), np.ones(len(face))], axis=1
    )
    return bent / np.linalg.norm(bent, axis=1, keepdims=True)


def _split(faces: np.ndarray, chart: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices once for each chart that they are in: their old index, uv, and the faces of them."""
    key = np.repeat(chart, 3) * (int(faces.max()) + 1) + faces.ravel()
    _, first, new = np.unique(key, return_index=True, return_inverse=True)
    return faces.ravel()[first], uv.reshape(-1, 2)[first], new.reshape(-1, 3)


def _ranges(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the group and place in it (both (sum,)) for groups of ``counts`` things."""
    index = np.repeat(np.arange(len(counts)), counts)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)


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
