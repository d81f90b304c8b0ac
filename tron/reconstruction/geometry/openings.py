"""Find the windows of a room from the photos' colours at its bounds.

A window is brighter than the surfaces it lights, but a white ceiling in a grey room, or the sun on a wall,
may be as bright as the outside. Photos tell these apart in two ways. Objects far behind the bounds show
parallax: photos agree by direction, not by place. And the sky is white in photos exposed for a room. A bright
place with neither parallax nor white is taken for a wall, because a lost wall is worse than a closed window.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from tron.captures import View
from tron.captures.view import CLIPPED, FLOOR, ToneCurve, decoded, linear_light
from tron.color import luminance
from tron.framing import even_directions
from tron.gaussians.fields import FIELDS
from tron.gaussians.harmonics import SH_C0
from tron.gaussians.scene import GaussianScene
from tron.reconstruction.geometry.seen_space import OPAQUE, pixels_of
from tron.reconstruction.progress import Track, untracked
from tron.tracing import SurfelTracer

SHINES = 2.0
"""Least luminance of a window, in medians of the surfels."""
HALF_A_SIDE = 0.5
"""Largest share of a side that white photos may open; more may be an overexposed wall."""
_REGION = 24  # neighbours whose median luminance counts: windows are larger than a surfel
_AROUND = 200  # neighbours whose parallax counts: an edge of what is outside is in sight
_FAR = 0.9  # of the disagreement by place, that by direction of what is far
_STILL = 0.1  # disagreement by place, in log luminance, of what does not move
_PAIRS = 20  # samples with both disagreements that tell anything
_SAME_WAY = 0.03  # radians within which two photos look the same way
_WAYS = 8  # directions of other photos that are compared at most
_PHOTOS = 48  # that are compared at most
_FLOOR = 0.7  # least cosine between the inward normal and up, of a floor
_SIDES, _FACING = 50, 0.7  # directions whose sides are looked at, and least cosine to a side's normals
_ITS_EDGES = 0.4  # the same with the edges that round it off
_LEAST_SIDE = 0.1  # share of the samples that make a side
_BEFORE = 0.8  # share of the way from the camera from which on surfels may be the bounds themselves
_NEARLY = 0.7  # of a window's least luminance, from which on surfels before it show it
_OUTSIDE = 1.03  # of a camera's distance to a window, from which on surfels lie behind it
_ENOUGH = 50  # pixels that tell a photo's exposure


@dataclass(frozen=True, eq=False)
class Shown:
    """Colours of N points in V photos.

    Attributes:
        light: (V, N, 3) linear, exposure and white balance divided out; NaN where a photo does not show it.
        white: (V, N) bool, where the photo is white in all channels.
        sky: (N,) bool, where most sky masks of photos that show it say so.
        color: (N, 3) median of ``light`` over the photos; NaN where none shows it.
    """

    light: np.ndarray
    white: np.ndarray
    sky: np.ndarray
    color: np.ndarray


def radiance_of(scene: GaussianScene, curve: ToneCurve) -> np.ndarray:
    """(M, 3) linear radiance of surfels, averaged over all directions; white is 1."""
    return decoded(np.clip(SH_C0 * scene.sh[:, 0] + 0.5, 0, 1), curve)


def gbuffers_of(
    scene: GaussianScene, views: Sequence[View], curve: ToneCurve, track: Track = untracked
) -> list[dict[str, np.ndarray]]:
    """Opacity and depth (H, W) of each view, and as base color (H, W, 3) the light of the surfels, linear."""
    tracer = SurfelTracer(replace(scene, base_color=radiance_of(scene, curve).astype(np.float32)))
    found = []
    for view in track(views, "what surfels hide"):
        maps = tracer.gbuffer(view.camera).numpy()
        found.append({name: maps[name] for name in ("opacity", "depth", "base_color")})
    return found


def shown_at(
    views: Sequence[View], seen: Sequence[Mapping[str, np.ndarray]], points: np.ndarray, curve: ToneCurve
) -> Shown:
    """Colours of points (N, 3) in the photos, divided by each photo's exposure and white balance.

    These are the median ratio of a photo's pixels to the surfels' picture.

    Args:
        views: photos. seen: :func:`gbuffers_of` them. points: world. curve: of the photos.
    """
    light = np.full((len(views), len(points), 3), np.nan, np.float32)
    white, sky = (np.zeros((len(views), len(points)), bool) for _ in range(2))
    for i, (view, maps) in enumerate(zip(views, seen, strict=True)):
        image, decoded_image = view.read(), linear_light(view, 1.0, curve)
        solid, believed = maps["opacity"] > OPAQUE, view.believed()
        told = solid & believed & (image.max(-1) < CLIPPED)
        if told.sum() >= _ENOUGH:
            pair = (np.log(np.maximum(pixels[told], FLOOR)) for pixels in (decoded_image, maps["base_color"]))
            decoded_image = decoded_image / np.exp(np.median(np.subtract(*pair), 0))
        column, row, _ = pixels_of(view, points)
        there = visible_in(view, maps, points) & believed[row, column]
        row, column = row[there], column[there]
        light[i, there], white[i, there] = decoded_image[row, column], image[row, column].min(-1) >= CLIPPED
        if view.has("sky_mask"):
            sky[i, there] = view.read("sky_mask")[row, column] > 0.5
    color = _medians(np.moveaxis(light, 0, -1))
    return Shown(light, white, 2 * sky.sum(0) > np.isfinite(light[..., 0]).sum(0), color)


def shining(
    points: np.ndarray,
    normals: np.ndarray,
    eyes: np.ndarray,
    shown: Shown,
    usual: float,
    up: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool twice: samples of a room's bounds that are windows, and equally bright ones that stay closed.

    Args:
        points, normals: (N, 3), normals unit, inwards.
        eyes: (V, 3) positions of the cameras.
        shown: what their photos show at the points.
        usual: :func:`usual_luminance` of the room's surfels.
        up: (3,) unit.
    """
    bright = np.zeros(len(points), bool)
    known = np.flatnonzero(np.isfinite(shown.color[:, 0]))
    if len(known) >= _REGION:
        near = KDTree(points[known]).query(points[known], k=_REGION)[1]
        bright[known] = np.median(luminance(shown.color[known])[near], 1) > SHINES * usual
    bright &= normals @ up < _FLOOR
    moves, white = bright.copy(), bright.copy()
    if bright.any():
        few = np.unique(np.linspace(0, len(eyes) - 1, _PHOTOS).astype(int))
        tree = KDTree(points[bright])
        near = tree.query(points[bright], k=min(_REGION, int(bright.sum())))[1].reshape(bright.sum(), -1)
        showing = np.isfinite(shown.light[:, bright, 0]).sum(0)
        white[bright] = (2 * shown.white[:, bright].sum(0) > showing)[near].mean(1) > 0.5
        light = np.log(np.maximum(luminance(shown.light[few][:, bright]), FLOOR))
        # Edges of a wall lie a pixel to either side in each photo, which is no parallax.
        even = np.where(np.isfinite(light), [_medians(photo[near]) for photo in light], np.nan)
        moves[bright] = _moves(points[bright], eyes[few], even, shown.white[few][:, bright])
    for axis in even_directions(_SIDES):
        side = normals @ axis > _FACING
        if side.mean() > _LEAST_SIDE and (white & ~moves)[side].mean() > HALF_A_SIDE:
            white &= normals @ axis <= _ITS_EDGES
    open_ = moves | white | shown.sky
    return open_, bright & ~open_


def _medians(values: np.ndarray) -> np.ndarray:
    """(...) medians of rows (..., K) without their NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of rows of NaN
        return np.nanmedian(values, axis=-1)


def _moves(points: np.ndarray, eyes: np.ndarray, light: np.ndarray, white: np.ndarray) -> np.ndarray:
    """(N,) bool: points (N, 3) around which photos agree by direction, not by place.

    Args:
        eyes: (V, 3). light: (V, N) log luminance, NaN where a photo does not show it. white: (V, N) bool;
            two of those are alike.
    """
    ways = np.stack([towards(eye, points) for eye in eyes])
    shows = np.isfinite(light)
    apart = np.zeros((3, len(points)))  # by place, by direction, photos with both
    for i in range(len(eyes)):
        here, others = np.flatnonzero(shows[i]), np.arange(len(eyes)) != i
        theirs = others[:, None] & shows
        if not len(here) or not theirs.any():
            continue
        own, own_white = light[i, here], white[i, here]
        by_place = np.where(white[:, here] & own_white, 0, np.abs(light[:, here] - own))
        near, j = KDTree(ways[theirs]).query(
            ways[i, here], k=np.arange(1, min(_WAYS, int(theirs.sum())) + 1), distance_upper_bound=_SAME_WAY
        )
        close = np.isfinite(near)
        j = np.where(close, j, 0)
        by_way = np.abs(light[theirs][j] - own[:, None])
        by_way = np.where(white[theirs][j] & own_white[:, None], 0, by_way)
        also, alike = theirs[:, here].sum(0), close.sum(1)
        both = (also > 0) & (alike > 0)
        place = np.where(theirs[:, here], by_place, 0).sum(0)[both] / also[both]
        way = np.where(close, by_way, 0).sum(1)[both] / alike[both]
        apart[:, here[both]] += np.stack([place, way, np.ones(both.sum())])
    region = KDTree(points).query(points, k=np.arange(1, min(_AROUND, len(points)) + 1))[1]
    place, way, pairs = apart[:, region].sum(2)
    return (pairs >= _PAIRS) & (place > _STILL * pairs) & (way < _FAR * place)


def usual_luminance(scene: GaussianScene, curve: ToneCurve) -> float:
    """Median luminance of the surfels, linear."""
    return float(np.median(luminance(radiance_of(scene, curve))))


def opened(
    scene: GaussianScene,
    views: Sequence[View],
    seen: Sequence[Mapping[str, np.ndarray]],
    points: np.ndarray,
    shines: np.ndarray,
    usual: float,
    curve: ToneCurve,
) -> GaussianScene:
    """The scene without surfels that stand in its windows with the sky painted on them.

    A surfel is removed if most photos that show it see it in front of a window and as bright, or behind the
    window. Window frames are dark and stay; a lamp in the room is also seen in front of walls, and stays.

    Args:
        scene: surfels.
        views: photos; their cameras are looked at.
        seen: :func:`gbuffers_of` them.
        points: (N, 3) samples of the bounds.
        shines: (N,) bool, of :func:`shining`.
        usual: :func:`usual_luminance` of the room's surfels.
        curve: of display images.
    """
    if not shines.any():
        return scene
    bright = luminance(radiance_of(scene, curve))
    before, visible = np.zeros(len(scene), int), np.zeros(len(scene), int)
    for view, maps in zip(views, seen, strict=True):
        there = np.flatnonzero(visible_in(view, maps, scene.means))
        eye, means = view.camera.position, scene.means[there]
        behind = KDTree(towards(eye, points)).query(towards(eye, means))[1]
        outside = distances(eye, means) > _OUTSIDE * distances(eye, points)[behind]
        before[there] += shines[behind] & (outside | (bright[there] > _NEARLY * SHINES * usual))
        visible[there] += 1
    kept = ~(2 * before > visible)
    return replace(scene, **{name: getattr(scene, name)[kept] for name in FIELDS})


def visible_in(view: View, seen: Mapping[str, np.ndarray], points: np.ndarray) -> np.ndarray:
    """(N,) bool: points that a view shows, or would show without surfels close in front of them.

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
