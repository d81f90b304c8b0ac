"""Backs of open sheets as separate polygons, because surfels face one way and a leaf is seen from both.

Meshes are taken as Blender takes them: every polygon is seen from either side, whatever ``doubleSided`` of a
glTF says. A sheet that its own edges close and that faces outwards shows no back, and gets none. Of all other
backs rays tell what is seen: where light from outside comes, straight or from other backs, as in a room with
a window. The inside of what stands open on a table, and of a tube but for its ends, is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from tron import seeds
from tron.gaussians.samples import Samples
from tron.models.parts import Part
from tron.models.surfels import areas, spread
from tron.runtime import activate, aligned, lanes

PROBES, RAYS, MOST_RAYS = 20_000, 16, 400_000
"""Points on backs, besides one a triangle; rays from each, fewer where these would be too many in all."""
LEAST, SENT, BOUNCES = 0.05, 0.5, 4
"""Of an even light around, the share that a back gets to be seen; what backs send on, and how often."""
CELLS = 128
"""Cells along the model's longest side: what is seen in a part of one is seen in all of it."""
BEHIND = 1e-3
"""Over that side, how far behind a glowing front its back lies."""
WELDED, OFF = 1e-6, 1e-5
"""Over that side: corners so near are one, and rays begin so far from a triangle."""


def two_sided(parts: Sequence[Part]) -> list[Part]:
    """The parts, then the backs of theirs that are seen, turned around, without normal maps: for surfels.

    Backs do not glow.

    Args:
        parts: of one model.
    """
    corners = np.concatenate([part.vertices[part.faces] for part in parts])
    normals = np.concatenate([part.normals[part.faces] for part in parts])
    low, side = corners.min((0, 1)), float(np.ptp(corners, axis=(0, 1)).max()) or 1.0
    corners = (corners - low) / side
    ahead = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(ahead, axis=1)
    agrees = np.where(np.einsum("fc,fkc->f", ahead, normals) < 0, -1.0, 1.0)
    front = ahead * (agrees / np.maximum(size, 1e-300))[:, None]
    bare = np.flatnonzero(~_closed(corners, agrees) & (size > 0))
    seen = np.zeros(len(corners), bool)
    if len(bare):
        seen[bare] = _seen(corners, front, bare)
    ends = np.cumsum([len(part.faces) for part in parts])
    backs = [
        replace(part, faces=part.faces[chosen][:, ::-1], normals=-part.normals, normal_map=None)
        for part, chosen in zip(parts, np.split(seen, ends[:-1]), strict=True)
        if chosen.any()
    ]
    # Rays would meet the dark back of a glowing sheet as often as its front.
    backs = [
        part
        if part.emission is None
        else replace(part, vertices=part.vertices + BEHIND * side * part.normals, emission=None)
        for part in backs
    ]
    return [*parts, *backs]


def spacing_of(parts: Sequence[Part], count: float) -> float:
    """Distance between neighbours of so many surfels on parts, in their units."""
    return float(np.sqrt(sum(areas(part).sum() for part in parts) / count))


def _closed(corners: np.ndarray, agrees: np.ndarray) -> np.ndarray:
    """(F,) whether a triangle belongs to a sheet that closes and faces outwards.

    Args:
        corners: (F, 3, 3), in units of the model's side.
        agrees: (F,) 1 where the normals look to the side from which corners turn left, else -1.
    """
    count, digits = len(corners), np.int64(round(1 / WELDED)) + 2
    x, y, z = np.round(corners.reshape(-1, 3) / WELDED).astype(np.int64).T
    corner = np.unique((x * digits + y) * digits + z, return_inverse=True)[1].reshape(count, 3)
    ends = np.stack([corner, np.roll(corner, -1, axis=1)], axis=-1).reshape(-1, 2)
    edge = np.unique(ends.min(1) * np.int64(3 * count) + ends.max(1), return_inverse=True)[1]
    # Closed: every edge is walked as often one way as the other.
    open_edge = np.bincount(edge, np.sign(ends[:, 1] - ends[:, 0])) != 0
    owner = np.repeat(np.arange(count), 3)
    shared = coo_matrix((np.ones(3 * count), (owner, count + edge)), shape=(count + len(open_edge),) * 2)
    sheet = connected_components(shared, directed=False)[1][:count]
    volume = np.einsum("fc,fc->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) * agrees
    inward = np.bincount(sheet, volume) < 0
    bare = np.bincount(sheet[owner], open_edge[edge]) > 0
    return ~(bare | inward)[sheet]


def _seen(corners: np.ndarray, front: np.ndarray, bare: np.ndarray) -> np.ndarray:
    """(B,) whether the backs of triangles ``bare`` are seen.

    Args:
        corners: (F, 3, 3) of all, in units of the model's side.
        front: (F, 3) unit normals.
        bare: (B,) int.
    """
    rng = seeds.generator(0, "backs that are seen")
    along, across = (corners[bare, k] - corners[bare, 0] for k in (1, 2))
    sizes = np.linalg.norm(np.cross(along, across), axis=1)
    face, weights = spread(sizes, PROBES, rng)
    face = np.concatenate([np.arange(len(bare)), face])
    weights = np.concatenate([np.full((len(bare), 3), 1 / 3), weights])
    back = -front[bare[face]]
    start = np.einsum("nk,nkc->nc", weights, corners[bare[face]])
    probe = np.repeat(np.arange(len(face)), int(np.clip(MOST_RAYS // len(face), 1, RAYS)))
    along = rng.normal(size=(len(probe), 3))
    along = along / np.linalg.norm(along, axis=1, keepdims=True) + 0.999 * back[probe]  # cosine-distributed
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    hit, other = _met(corners, (start + OFF * back)[probe], along)
    left = other < 0
    inner = ~left & (np.einsum("nc,nc->n", front[other], along) > 0)
    places = {
        "position": np.concatenate([start, hit[inner]]),
        "normal": np.concatenate([back, -front[other[inner]]]),
    }
    number = len(places["position"])
    cell = Samples(places, np.ones(number), np.zeros(number, np.int64)).cells(1 / CELLS)
    own, met = cell[: len(face)], cell[len(face) :]
    count = int(cell.max()) + 1
    sees = coo_matrix((np.ones(len(met)), (own[probe[inner]], met)), shape=(count, count)).tocsr()
    rays = np.maximum(np.bincount(own[probe], minlength=count), 1)
    reached = direct = np.bincount(own[probe[left]], minlength=count) / rays
    for _ in range(BOUNCES):
        reached = direct + SENT * (sees @ reached) / rays
    return np.bincount(face, reached[own] > LEAST, len(bare)) > 0


def _met(corners: np.ndarray, start: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points that rays meet first, and (N,) numbers of their triangles, -1 where they meet none."""
    if mi.variant() is None:
        activate()
    mesh = mi.Mesh("all", 3 * len(corners), len(corners))
    values = mi.traverse(mesh)
    values["vertex_positions"] = mi.Float(aligned(corners.astype(np.float32).ravel()))
    values["faces"] = dr.arange(mi.UInt32, 3 * len(corners))
    values.update()
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    si = scene.ray_intersect_preliminary(mi.Ray3f(lanes(mi.Point3f, start), lanes(mi.Vector3f, along)))
    face = np.array(dr.select(si.is_valid(), mi.Int32(si.prim_index), -1))
    return start + np.where(face >= 0, np.array(si.t), 0)[:, None] * along, face
