"""Regions of a scene, grown along its surface from a few surfels over similar neighbours.

A graph joins each surfel to its nearest neighbours. :func:`grown` takes what hangs together with the seeds
over small steps; :func:`parted` lets clicks inside and outside compete: every surfel goes to the seed that is
nearer along the surface. The second needs no threshold that would have to fit the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from tron.errors import TronError
from tron.gaussians.scene import GaussianScene

NEIGHBOURS = 12
LEAST_OPACITY = 0.05
"""Fainter surfels join nothing."""
REACH = 3.0
"""Neighbours are joined up to so many times the distance to their three nearest."""
# Cost of a step between neighbours, a spacing long: of its length, of the square of the normal's bend, of the
# square of the change of colour. Squares forgive noise and curvature, which fine surfels share out over many
# steps. Things are convex and meet in creases (Stein et al. 2014, "Object partitioning using local
# convexity"), so that a ridge counts less than a crease where normals have a sign.
_LENGTH, _BEND, _TINT, _RIDGE = 0.01, 20.0, 60.0, 0.3
_MOST_TINT = 0.25
"""Change of colour beyond which an edge costs no more: else the tiles of one floor are kept apart."""
_STEP = 0.05
"""Length of a step between surfels at one place, spacings."""


@dataclass(frozen=True)
class _Graph:
    """Edges between the surfels that can be seen.

    Attributes:
        seen: (N,) numbers of those surfels. back: (M,) their place in ``seen``, -1 of the others.
        start, end: (E,) places in ``seen`` that an edge joins.
        length: (E,) world units. local: (N,) mean distance to the three nearest.
        bend: (E,) 1 - cosine between normals. ridge: (E,) bool, known to bend outwards. tint: (E,)
            distance of colours, as cube roots of base color, about as even as lightness.
    """

    seen: np.ndarray
    back: np.ndarray
    start: np.ndarray
    end: np.ndarray
    length: np.ndarray
    local: np.ndarray
    bend: np.ndarray
    ridge: np.ndarray
    tint: np.ndarray

    @classmethod
    def of(cls, scene: GaussianScene) -> _Graph:
        seen = np.flatnonzero(scene.opacities() > LEAST_OPACITY)
        if len(seen) < 2:
            raise TronError("fewer than two surfels of the scene can be seen")
        points = scene.means[seen].astype(np.float64)
        count = min(NEIGHBOURS, len(seen) - 1)
        distances, nearest = map(np.asarray, KDTree(points).query(points, k=count + 1))
        length, end = distances[:, 1:], nearest[:, 1:].ravel()
        start = np.repeat(np.arange(len(seen)), count)
        normals, color = scene.normals()[seen], np.cbrt(np.clip(scene.base_color[seen], 0, 1))
        cosine = np.einsum("ei,ei->e", normals[start], normals[end])
        back = np.full(len(scene), -1)
        back[seen] = np.arange(len(seen))
        outwards = np.einsum("ei,ei->e", normals[end] - normals[start], points[end] - points[start]) > 0
        return cls(
            seen=seen,
            back=back,
            start=start,
            end=end,
            length=length.ravel(),
            local=length[:, :3].mean(1),
            bend=np.maximum(1 - (cosine if scene.oriented else np.abs(cosine)), 0),
            ridge=outwards & scene.oriented,
            tint=np.linalg.norm(color[start] - color[end], axis=1),
        )

    def places(self, surfels: np.ndarray) -> np.ndarray:
        """Places of surfels in the graph; TronError where none of them can be seen."""
        places = self.back[np.unique(surfels)]
        if not (places >= 0).any():
            raise TronError("no surfel that was picked can be seen", mend="pick others")
        return places[places >= 0]

    def selection(self, chosen: np.ndarray) -> np.ndarray:
        """(M,) bool of (N,) bool."""
        selected = np.zeros(len(self.back), bool)
        selected[self.seen[chosen]] = True
        return selected


def grown(scene: GaussianScene, seeds: np.ndarray, angle_deg: float, color: float) -> np.ndarray:
    """(M,) bool: surfels that hang together with the seeds over neighbours that are alike.

    Args:
        scene: the surfels.
        seeds: numbers of surfels.
        angle_deg: most angle between the normals of two neighbours.
        color: most distance between the cube roots of their base colors.

    Raises:
        TronError: no seed can be seen.
    """
    graph = _Graph.of(scene)
    places = graph.places(seeds)
    near = graph.length <= REACH * np.maximum(graph.local[graph.start], graph.local[graph.end])
    alike = near & (graph.bend <= 1 - np.cos(np.radians(angle_deg)) + 1e-6) & (graph.tint <= color)
    edges = graph.start[alike], graph.end[alike]
    count = len(graph.seen)
    joined = coo_matrix((np.ones(alike.sum(), bool), edges), shape=(count, count))
    part = connected_components(joined, directed=False)[1]
    return graph.selection(np.isin(part, part[places]))


def parted(scene: GaussianScene, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """(M,) bool: surfels nearer to a seed inside than to one outside, along the surface.

    Shortest paths on the graph of neighbours (Dijkstra's algorithm, from all seeds at once); a step costs
    little along a smooth surface of one colour, and much across creases and edges of colour.

    Args:
        scene: the surfels.
        inside, outside: numbers of surfels.

    Raises:
        TronError: no seed of either kind can be seen, or one is of both kinds.
    """
    graph = _Graph.of(scene)
    within, without = graph.places(inside), graph.places(outside)
    if len(np.intersect1d(within, without)):
        raise TronError("a surfel was picked both inside and outside", mend="move one of the two clicks")
    bend = np.where(graph.ridge, _RIDGE, 1.0) * graph.bend**2
    tint = np.minimum(graph.tint, _MOST_TINT) ** 2
    cost = (graph.length / scene.spacing + _STEP) * (_LENGTH + _BEND * bend + _TINT * tint)
    count = len(graph.seen)
    one_way = coo_matrix((cost, (graph.start, graph.end)), shape=(count, count)).tocsr()
    both_ways = one_way.maximum(one_way.T)
    seeds = np.concatenate([within, without])
    nearest = dijkstra(both_ways, indices=seeds, min_only=True, return_predecessors=True)[2]
    return graph.selection(np.isin(nearest, within))
