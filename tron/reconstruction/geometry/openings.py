"""Windows of a room, by what photos show where its bounds are.

A window of radiance L lights a wall beside it with at most half of L, and none of the wall's albedo is above
0.8: whatever L lights is less than 0.4 L. So what is several times as bright as the surfels that photos show
is the light itself. A floor is not, however the sun shines on it.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from tron.captures import View
from tron.captures.view import CLIPPED, FLOOR, ToneCurve, decoded, linear_light
from tron.color import luminance
from tron.gaussians.fields import FIELDS
from tron.gaussians.harmonics import SH_C0
from tron.gaussians.scene import GaussianScene
from tron.reconstruction.geometry.seen_space import OPAQUE, pixels_of
from tron.reconstruction.progress import Track, untracked
from tron.tracing import SurfelTracer

SHINES = 2.0
"""Luminance of a window, in medians of the surfels."""
_REGION = 24  # neighbours whose median luminance counts: windows are larger than a surfel
_FLOOR = 0.7  # least cosine between the inward normal and up, of a floor
_BEFORE = 0.8  # share of the way from the camera from which on surfels may be the bounds themselves
_NEARLY = 0.7  # of a window's least luminance, from which on surfels before it show it
_OUTSIDE = 1.03  # of a camera's distance to a window, from which on surfels lie behind it
_ENOUGH = 50  # pixels that tell a photo's exposure


def radiance_of(scene: GaussianScene, curve: ToneCurve) -> np.ndarray:
    """(M, 3) linear light that surfels send out in the mean of all directions, white is 1."""
    return decoded(np.clip(SH_C0 * scene.sh[:, 0] + 0.5, 0, 1), curve)


def shown_at(
    scene: GaussianScene,
    views: Sequence[View],
    points: np.ndarray,
    curve: ToneCurve,
    track: Track = untracked,
) -> np.ndarray:
    """(N, 3) linear light that photos show at points (N, 3); NaN where none does.

    Medians over the photos, each divided by its exposure and white balance: the median ratio of its pixels to
    what the surfels show there.
    """
    tracer = SurfelTracer(replace(scene, base_color=radiance_of(scene, curve).astype(np.float32)))
    colors = np.full((len(views), len(points), 3), np.nan, np.float32)
    for color, view in zip(colors, track(views, "photos of what bounds the space"), strict=True):
        seen, light = tracer.gbuffer(view.camera).numpy(), linear_light(view, 1.0, curve)
        solid, believed = seen["opacity"] > OPAQUE, view.believed()
        told = solid & believed & (view.read().max(-1) < CLIPPED)
        if told.sum() >= _ENOUGH:
            pair = (np.log(np.maximum(image[told], FLOOR)) for image in (light, seen["base_color"]))
            light = light / np.exp(np.median(np.subtract(*pair), 0))
        column, row, _ = pixels_of(view, points)
        there = visible_in(view, seen, points) & believed[row, column]
        color[there] = light[row[there], column[there]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of points that no photo shows
        return np.nanmedian(colors, axis=0)


def shining(
    points: np.ndarray, normals: np.ndarray, shown: np.ndarray, usual: float, up: np.ndarray
) -> np.ndarray:
    """(N,) bool: samples of a room's bounds through which light comes in.

    Args:
        points, normals: (N, 3), normals unit, inwards.
        shown: (N, 3) of :func:`shown_at`.
        usual: :func:`usual_luminance` of the room's surfels.
        up: (3,) unit.
    """
    found = np.zeros(len(points), bool)
    known = np.flatnonzero(np.isfinite(shown[:, 0]))
    if len(known) >= _REGION:
        near = KDTree(points[known]).query(points[known], k=_REGION)[1]
        found[known] = np.median(luminance(shown[known])[near], 1) > SHINES * usual
    return found & (normals @ up < _FLOOR)


def usual_luminance(scene: GaussianScene, curve: ToneCurve) -> float:
    """Median luminance of the surfels, linear."""
    return float(np.median(luminance(radiance_of(scene, curve))))


def opened(
    scene: GaussianScene,
    views: Sequence[View],
    points: np.ndarray,
    shines: np.ndarray,
    usual: float,
    curve: ToneCurve,
) -> GaussianScene:
    """The scene without surfels that stand in its windows with the sky painted on them.

    Those go that most photos that show them have before a window, as bright as one, or behind it. Frames are
    dark and stay; a lamp within the room is before walls too, and stays.

    Args:
        scene: surfels.
        views: photos; their cameras are looked at.
        points: (N, 3) samples of the bounds.
        shines: (N,) bool, of :func:`shining`.
        usual: :func:`usual_luminance` of the room's surfels.
        curve: of display images.
    """
    if not shines.any():
        return scene
    tracer, bright = SurfelTracer(scene), luminance(radiance_of(scene, curve))
    before, visible = np.zeros(len(scene), int), np.zeros(len(scene), int)
    for view in views:
        seen = np.flatnonzero(visible_in(view, tracer.gbuffer(view.camera).numpy(), scene.means))
        eye, means = view.camera.position, scene.means[seen]
        behind = KDTree(towards(eye, points)).query(towards(eye, means))[1]
        outside = distances(eye, means) > _OUTSIDE * distances(eye, points)[behind]
        before[seen] += shines[behind] & (outside | (bright[seen] > _NEARLY * SHINES * usual))
        visible[seen] += 1
    kept = ~(2 * before > visible)
    return replace(scene, **{name: getattr(scene, name)[kept] for name in FIELDS})


def visible_in(view: View, seen: Mapping[str, np.ndarray], points: np.ndarray) -> np.ndarray:
    """(N,) bool: points that a view shows, or would but for what is close before them.

    Args:
        view: its image is not looked at. seen: its G-buffer. points: (N, 3) world.
    """
    column, row, inside = pixels_of(view, points)
    way = distances(view.camera.position, points)
    depth = np.where(seen["opacity"] > OPAQUE, seen["depth"], np.inf)
    return inside & (depth[row, column] > _BEFORE * way)


def distances(origin: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) from one position to points (N, 3)."""
    return np.linalg.norm(points - origin, axis=1)


def towards(origin: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 3) unit directions from one position to points (N, 3)."""
    return (points - origin) / np.maximum(distances(origin, points), 1e-12)[:, None]
