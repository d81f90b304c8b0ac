"""The part of space that pictures show, and bounds of a room where none looked.

Where several pictures look, surfaces can be found at all. By a ceiling that nobody filmed a new light would
shine in: :func:`enclosed` samples the surfels' convex hull. A point of it that a camera's position sees
through no surfel, and that no photo has in its picture, is part of a wall that was not photographed; one that
a photo does have in its picture is an opening, since surfels would be there otherwise. Nothing is known of
such walls but that they are there: they get the mean colour of the surfels near by.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import ConvexHull, KDTree

from tron.cameras import focus_of
from tron.captures import Capture, View
from tron.errors import TronError
from tron.gaussians.harmonics import SH_COUNT
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.reconstruction.progress import Track, untracked
from tron.runtime import lanes
from tron.seeds import generator
from tron.tracing import SurfelTracer

_DRAWS = 64
_DRAWS_OF_BOX = 16
_LEAST_SHARE = 0.25
_INSIDE = 0.95
_OUTWARD = 4.0
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


def random_points(capture: Capture, count: int, seed: int) -> np.ndarray:
    """(count, 3) float32 points, uniform over the part of the cameras' box that the pictures show.

    The box is that of the camera positions, made symmetric about the point that the cameras look at, and a
    few times as large where they look outwards. Points that few cameras see are left out, and so are those
    that the masks show to be empty (the visual hull of Laurentini 1994, with some tolerance). What is left
    may be so small that fewer points are found.
    """
    views = capture.train_views
    focus, outward = focus_of([view.camera.camera_to_world for view in views])
    reach = np.abs(np.stack([view.camera.position for view in views]) - focus).max(axis=0)
    reach = np.maximum(reach, 0.1 * reach.max()) * (_OUTWARD if outward else 1)
    masks = [view.read("mask") > 0.5 if view.has("mask") else None for view in views]
    rng = generator(seed, "reconstruction", "random points")
    centre = focus
    seen, inside, points = [], [], []
    chosen = np.zeros((0, 3))
    for draw in range(_DRAWS):
        if draw >= _DRAWS_OF_BOX and len(chosen) > 1:
            # A small subject in a large box: go on in the box around what was found of it, and some more.
            low, high = chosen.min(axis=0), chosen.max(axis=0)
            centre, reach = (low + high) / 2, np.minimum(0.6 * (high - low), reach)
        batch = centre + rng.uniform(-1, 1, (count, 3)) * reach
        shown, filled = _coverage(batch, views, masks)
        points.append(batch)
        seen.append(shown)
        inside.append(filled)
        most = max(np.max(s) for s in seen)
        kept = [(s >= max(_LEAST_SHARE * most, 1)) & (f >= _INSIDE * s) for s, f in zip(seen, inside)]
        chosen = np.concatenate([p[k] for p, k in zip(points, kept)])[:count]
        if len(chosen) == count:
            break
    if len(chosen) < min(count, 4):
        raise TronError("no part of space is seen by several cameras", mend="check the poses and the masks")
    return chosen.astype(np.float32)


def _coverage(
    points: np.ndarray, views: Sequence[View], masks: Sequence[np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of views, (N,) each, that have a point in their picture, and that have it on the subject."""
    seen, inside = np.zeros(len(points), int), np.zeros(len(points), int)
    for view, mask in zip(views, masks):
        column, row, within = pixels_of(view, points)
        seen += within
        inside += within if mask is None else within & mask[row, column]
    return seen, inside


def pixels_of(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows, (N,) int each, of world points, and whether the picture shows them."""
    camera = view.camera
    pixels, depth = camera.project(points)
    with np.errstate(invalid="ignore"):
        within = (depth > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
        column, row = np.where(within[:, None], pixels, 0).astype(int).T
    return column, row, within


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
    return tracer.transmittance(start, lanes(mi.Vector3f, ways)).numpy()


def even_directions(count: int) -> np.ndarray:
    """(count, 3) unit vectors on Fibonacci's spiral (Gonzalez 2010, Measurement of areas on a sphere)."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
