"""Bounds of a room where no photo looked: by a ceiling that nobody filmed a new light would shine in.

The surfels' convex hull is sampled. A point of it that a camera's position sees through no surfel, and that
no photo has in its picture, is part of a wall that was not photographed; one that a photo does have in its
picture is an opening, since surfels would be there otherwise. Nothing is known of such walls but that they
are there: they get the mean colour of the surfels near by.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import ConvexHull, KDTree

from tron.captures import View
from tron.gaussians.harmonics import SH_COUNT
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.priors import Track, untracked
from tron.reconstruction.even_directions import even_directions
from tron.reconstruction.seen_space import pixels_of
from tron.seeds import generator
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

POINTS = 20_000
"""Samples of the hull."""
_DIRECTIONS = 200
_WITHIN = 0.995  # share of the surfels in each of them that the hull is of: those beyond stray
_SOLID = 0.5  # opacity of surfels that count
_OPEN = 0.3  # transmittance from here on: no surface was found
_MOST = 0.5  # share of the hull that is closed in silence
_RADIUS = 0.8  # standard deviation of a new surfel, distances between samples: larger ones cover windows
_NEAR = 32  # surfels that tell the colour
_OPACITY_LOGIT = 6.0  # opacity 0.998
_ROUGHNESS = 0.7  # of plaster and paint, nearly diffuse


def enclosed(
    scene: GaussianScene, views: Sequence[View], seed: int, track: Track = untracked
) -> GaussianScene:
    """The scene (world frame and units) with surfels where it is bounded and no view looks.

    The new ones face inwards, are opaque and nearly diffuse; base color (linear) and the constant harmonic
    (display) are means of what is near.

    Args:
        scene: surfels of a room; those that are there stay, and come first.
        views: taken inside it; cameras are looked at, not images.
        seed: root of the random numbers.
        track: wraps the loop over the views.
    """
    solid = scene.means[scene.opacities() > _SOLID].astype(np.float64)
    if len(solid) < _NEAR:
        return scene
    cameras = np.stack([view.camera.position for view in views])
    points, normals, spacing = _hull(solid, cameras, seed)
    tracer = SurfelTracer(scene)
    free, pictured = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for view in track(views, "photos of the room's bounds"):
        through = _transmittance(tracer, view.camera.position, points) > _OPEN
        free |= through
        pictured |= through & pixels_of(view, points)[2]
    lacking = free & ~pictured
    count = int(lacking.sum())
    log.info(
        "indoors: %d surfels close %.0f %% of what bounds the room; %.0f %% are openings that photos show",
        count, 100 * lacking.mean(), 100 * pictured.mean(),
    )  # fmt: skip
    if lacking.mean() > _MOST:
        log.warning("photos show little of what bounds the room: indoors=true is for photos from within one")
    if not count:
        return scene
    there = np.flatnonzero(scene.opacities() > _SOLID)
    near = there[KDTree(solid).query(points[lacking], k=_NEAR)[1]]
    sh = np.zeros((count, SH_COUNT, 3))
    sh[:, 0] = scene.sh[near, 0].mean(1)
    new = {
        "means": points[lacking],
        "quats": quats_from_normals(normals[lacking]),
        "log_scales": np.full((count, 2), np.log(_RADIUS * spacing)),
        "opacity_logits": np.full(count, _OPACITY_LOGIT),
        "sh": sh,
        "base_color": scene.base_color[near].mean(1),
        "roughness": np.full(count, _ROUGHNESS),
        "metallic": np.zeros(count),
        "object_id": np.zeros(count),
    }
    return replace(scene, **{name: np.concatenate([getattr(scene, name), new[name]]) for name in new})


def _hull(means: np.ndarray, cameras: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Points (N, 3) even over the hull of surfels and cameras, unit normals (N, 3) inwards, spacing."""
    middle = cameras.mean(0)
    kept = np.ones(len(means), bool)
    for direction in even_directions(_DIRECTIONS):
        along = means @ direction
        kept &= along <= np.quantile(along, _WITHIN)
    hull = ConvexHull(np.concatenate([means[kept], cameras]) - middle, qhull_options="QJ")
    corners = hull.points[hull.simplices]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    rng = generator(seed, "reconstruction", "enclosure")
    facet = rng.choice(len(area), POINTS, p=area / area.sum())
    share = rng.dirichlet((1.0, 1.0, 1.0), POINTS)
    points = middle + np.einsum("nk,nki->ni", share, corners[facet])
    return points, -hull.equations[facet, :3], float(np.sqrt(area.sum() / POINTS))


def _transmittance(tracer: SurfelTracer, origin: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) from one position towards points (N, 3) and beyond."""
    ways = points - origin
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    start = mi.Point3f(*(dr.full(mi.Float, float(x), len(points)) for x in origin))
    return tracer.transmittance(start, mi.Vector3f(ways.T.astype(np.float32))).numpy()
