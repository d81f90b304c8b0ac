"""Close a room where no photo looked, and decide whether photos were taken in one.

A new light would shine in through a ceiling that nobody filmed, and be blocked by surfels that show the sky
in windows. The convex hull of surfels and cameras is sampled. Samples that photos show bright, and far away
or white, are windows (:mod:`tron.reconstruction.geometry.openings`): their surfels are removed. If a camera
meets no surfel towards a sample, and no photo shows a window there, a wall is added. It gets its colour from
the photos, or without a photo the mean colour of the nearest surfels.

Cameras are in a room if surfels surround them on all sides, some of them overhead, and photos show few
openings overhead. A place among trees filmed from above cannot be decided.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import ConvexHull, KDTree

from tron.captures import View
from tron.captures.view import ToneCurve, encoded
from tron.color import luminance
from tron.framing import even_directions
from tron.gaussians.harmonics import SH_C0, SH_COUNT
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.reconstruction.geometry.openings import (
    gbuffers_of,
    opened,
    shining,
    shown_at,
    towards,
    usual_luminance,
)
from tron.reconstruction.geometry.seen_space import pixels_of
from tron.reconstruction.progress import Track, untracked
from tron.reconstruction.settings import Indoors
from tron.runtime import lanes
from tron.seeds import generator
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)
POINTS = 20_000
"""Samples of the hull."""
AROUND, PERHAPS = 0.7, 0.45
"""Share of the level directions that end on a surfel, in a room and in what may be one."""
OVERHEAD = 0.4
"""Share of the hull overhead that photos of a room may show to be open: windows, and what was not found."""
OVER = 0.1
"""Share of the rising directions that end on a surfel in a room, whose walls are higher than a hedge."""
_DIRECTIONS = 200
_LEVEL, _RISING = np.sin(np.radians([15.0, 30.0]))
"""Sines of the elevation up to which a direction is level, and from which it is overhead."""
_PLACES = 12  # cameras that look around
_WITHIN = 0.995  # share of the surfels in each of them that the hull is of: those beyond stray
_SOLID = 0.5  # opacity of surfels that count
_OPEN = 0.3  # transmittance from here on: no surface was found
_MOST = 0.5  # share of the hull that is closed in silence
_ROUNDS = 4  # of looking for windows: sky that surfels showed outside of one bent the hull
_FEW = 0.01  # share of surfels from which on another round is worth its while, of the hull that is told of
_RADIUS = 0.8  # standard deviation of a new surfel, distances between samples: larger ones cover windows
_NEAR = 32  # surfels that tell the colour
_FEWEST = 10 * _NEAR  # surfels that bound anything
_OPACITY_LOGIT = 6.0  # opacity 0.998
_ROUGHNESS = 0.7  # of plaster and paint, nearly diffuse
_SIDE = 256  # pixels of the longer side of photos that are looked at: samples lie no closer


class Enclosed(NamedTuple):
    """A room with its bounds, and how many surfels were taken out of its windows."""

    scene: GaussianScene
    opened: int


@dataclass(frozen=True, eq=False)
class Bounds:
    """N samples of what bounds the space that surfels and cameras lie in.

    Attributes:
        points: (N, 3) world.
        normals: (N, 3) unit, inwards.
        spacing: mean distance between them, world units.
        lacking: (N,) bool, a camera meets no surfel there and no photo shows it.
        pictured: (N,) bool, a camera meets no surfel there and its photo shows it.
        shown: (N, 3) linear colour in the photos; NaN if none shows it.
        shines: (N,) bool, the sample is a window.
        shut: (N,) bool, the sample is as bright as a window but nothing proves one.
        seen: the surfels' G-buffer in each photo, of :func:`gbuffers_of`.
        around: share of the level directions from the cameras that end on a surfel.
        over: share of the rising directions that end on a surfel.
        overhead: share of the overhead samples that are pictured and at least as bright as the surfels.
    """

    points: np.ndarray
    normals: np.ndarray
    spacing: float
    lacking: np.ndarray
    pictured: np.ndarray
    shown: np.ndarray
    shines: np.ndarray
    shut: np.ndarray
    seen: list[dict[str, np.ndarray]]
    around: float
    over: float
    overhead: float

    @property
    def room(self) -> bool | None:
        """Whether these are the bounds of a room; None if undecided."""
        if self.overhead > OVERHEAD or self.around < PERHAPS:
            return False
        return True if self.around >= AROUND and self.over >= OVER else None


def closed_indoors(
    scene: GaussianScene,
    views: Sequence[View],
    indoors: Indoors,
    seed: int,
    curve: ToneCurve = "srgb",
    track: Track = untracked,
) -> Enclosed:
    """The scene (world frame and units), with surfels where a room is bounded and none in its windows.

    The new ones face inwards, are opaque and nearly diffuse; base color (linear) and the constant harmonic
    (display) are those of photos, and means of what is near where no photo looks.

    Args:
        scene: surfels; those that stay come first.
        views: photos.
        indoors: whether they were taken in a room; auto: where :attr:`Bounds.room` says so, and no mask of
            theirs says what is subject or sky.
        seed: root of the random numbers.
        curve: of the photos.
        track: wraps the loop over the views.
    """
    if not indoors or (indoors == "auto" and any(view.has("mask") or view.has("sky_mask") for view in views)):
        return Enclosed(scene, 0)
    cameras = np.stack([view.camera.position for view in views])
    if indoors == "auto" and _bounded(SurfelTracer(scene), cameras)[0] < PERHAPS:
        return Enclosed(scene, 0)
    views = [_small(view) for view in views]
    usual = usual_luminance(scene, curve)
    bounds = bounds_of(scene, views, seed, curve, track, usual)
    if bounds is None:
        return Enclosed(scene, 0)
    if indoors == "auto" and bounds.room is None:
        log.warning(
            "these may be photos of a room: surfaces stand on %.0f %% of all sides of the cameras; if it is "
            "one, indoors=true closes what no photo shows, and if not, indoors=false says so",
            100 * bounds.around,
        )
    if indoors == "auto" and bounds.room:
        log.warning("taken for photos of a room, which is closed; indoors=false if it is none")
    if not (indoors is True or bounds.room):
        return Enclosed(scene, 0)
    learnt = len(scene)
    for _ in range(_ROUNDS):
        before = len(scene)
        scene = opened(scene, views, bounds.seen, bounds.points, bounds.shines, usual, curve)
        if len(scene) == before:
            break
        bounds = bounds_of(scene, views, seed, curve, track, usual)
        if bounds is None:
            return Enclosed(scene, learnt - len(scene))
        if before - len(scene) < _FEW * before:
            break
    if len(scene) < learnt:
        log.info(
            "indoors: %d surfels that showed the sky were taken out of windows; pictures are judged before",
            learnt - len(scene),
        )
    if bounds.shut.mean() > _FEW:
        log.warning(
            "%.0f %% of what bounds the room is bright as a window and taken for white walls or the sun on "
            "them, as no photo shows it far away or white; a sky_mask of the photos and indoors=true open it",
            100 * bounds.shut.mean(),
        )
    return Enclosed(enclosed(scene, bounds, curve), learnt - len(scene))


def _small(view: View) -> View:
    """The view with all needed maps read and reduced."""
    small = view.reduced(max(max(view.camera.width, view.camera.height) / _SIDE, 1))
    maps = {name: small.read(name) for name in ("image", "valid", "sky_mask") if small.has(name)}
    return View(small.name, small.camera, space=small.space, **maps)


def bounds_of(
    scene: GaussianScene,
    views: Sequence[View],
    seed: int,
    curve: ToneCurve = "srgb",
    track: Track = untracked,
    usual: float | None = None,
) -> Bounds | None:
    """Bounds of the space of surfels and cameras; None where there are next to no surfels.

    Args:
        scene, views, seed, curve, track: as of :func:`closed_indoors`.
        usual: luminance that a window's is told by; None: that of these surfels.
    """
    solid = scene.means[scene.opacities() > _SOLID].astype(np.float64)
    if len(solid) < _FEWEST:
        return None
    cameras = np.stack([view.camera.position for view in views])
    points, normals, spacing = _hull(solid, cameras, seed)
    tracer = SurfelTracer(scene)
    free, pictured = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for view in track(views, "what bounds the space"):
        through = _transmittance(tracer, view.camera.position, points) > _OPEN
        free |= through
        pictured |= through & pixels_of(view, points)[2]
    rising = points - cameras.mean(0)
    overhead = rising @ scene.up > _RISING * np.linalg.norm(rising, axis=1)
    seen = gbuffers_of(scene, views, curve, track)
    shown = shown_at(views, seen, points, curve)
    usual = usual_luminance(scene, curve) if usual is None else usual
    sky = pictured & (luminance(shown.color) > usual)
    return Bounds(
        points, normals, spacing, free & ~pictured, pictured, shown.color,
        *shining(points, normals, cameras, shown, usual, scene.up), seen, *_bounded(tracer, cameras),
        float(sky[overhead].mean()) if overhead.any() else 0.0,
    )  # fmt: skip


def _bounded(tracer: SurfelTracer, cameras: np.ndarray) -> tuple[float, float]:
    """Shares of level and of rising directions from some of the cameras (V, 3) that end on a surfel."""
    directions = even_directions(5 * _DIRECTIONS)
    height = directions @ tracer.scene.up
    places = cameras[np.unique(np.linspace(0, len(cameras) - 1, _PLACES).astype(int))]
    met = np.mean([_transmittance(tracer, place, place + directions) < _OPEN for place in places], axis=0)
    return float(met[np.abs(height) < _LEVEL].mean()), float(met[height > _RISING].mean())


def enclosed(scene: GaussianScene, bounds: Bounds, curve: ToneCurve) -> GaussianScene:
    """The scene with surfels where bounds are lacking; see :func:`closed_indoors`."""
    unfound = bounds.pictured & ~bounds.shines & np.isfinite(bounds.shown[:, 0])
    lacking = bounds.lacking | unfound
    count = int(lacking.sum())
    log.info(
        "indoors: %d surfels close %.0f %% of what bounds the room; %.0f %% are openings that photos show",
        count, 100 * lacking.mean(), 100 * (bounds.pictured & ~unfound).mean(),
    )  # fmt: skip
    if lacking.mean() > _MOST:
        log.warning("photos show little of what bounds the room: indoors=false if they were taken elsewhere")
    if not count:
        return scene
    there = np.flatnonzero(scene.opacities() > _SOLID)
    points = bounds.points[lacking]
    near = there[KDTree(scene.means[there].astype(np.float64)).query(points, k=_NEAR)[1]]
    photographed, shown = unfound[lacking], bounds.shown[unfound]
    sh, base_color = np.zeros((count, SH_COUNT, 3)), scene.base_color[near].mean(1)
    sh[:, 0] = scene.sh[near, 0].mean(1)
    sh[photographed, 0] = (encoded(shown, curve) - 0.5) / SH_C0
    base_color[photographed] = np.clip(shown, 0, 1)
    new = {
        "means": points,
        "quats": quats_from_normals(bounds.normals[lacking]),
        "log_scales": np.full((count, 2), np.log(_RADIUS * bounds.spacing)),
        "opacity_logits": np.full(count, _OPACITY_LOGIT),
        "sh": sh,
        "base_color": base_color,
        "roughness": np.full(count, _ROUGHNESS),
        "metallic": np.zeros(count),
        "object_id": np.zeros(count),
        "log_thickness": np.full(count, -np.inf),
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
    ways = towards(origin, points)
    start = mi.Point3f(*(dr.full(mi.Float, float(x), len(points)) for x in origin))
    return tracer.transmittance(start, lanes(mi.Vector3f, ways)).numpy()
