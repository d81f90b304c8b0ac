"""The first surfels of a capture: from its points, from depth maps, or from nothing but the cameras."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import logit

from tron.captures import Capture, View
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.gaussians.harmonics import SH_COUNT, rgb_to_dc
from tron.gaussians.initialize import GBufferView, surfels_from_gbuffers
from tron.gaussians.scene import (
    GaussianScene,
    measure_spacing,
    neighbour_distances,
    quats_from_normals,
)
from tron.reconstruction.geometry.seen_space import pixels_of, random_points
from tron.reconstruction.progress import Track, untracked
from tron.reconstruction.settings import InitialSettings, Place
from tron.seeds import generator

log = logging.getLogger(__name__)

Source = Literal["points", "depth", "stereo", "random"]

_EXTENT_MARGIN = 1.1
_SAME_PLACE = 1e-9  # rounding moves cameras that turn on the spot by about 1e-16
_ABOUT = 0.99  # surfels from depth maps are as many as asked for within half a percent
_SOME = 10_000  # points that tell how far away they all are
_DENSE = 2.0  # pixels between points that cover surfaces; structure from motion's lie farther apart
_FEWEST = 0.05  # share of pixels with a confirmed depth below which stereo has found nothing but chance
_SUBJECT = 0.5
# A few pixels per surfel suffice for surfels of that size.
_PIXELS_PER_SURFEL = 64


@dataclass(frozen=True, eq=False)
class Beginning:
    """First surfels, and how they were found.

    Attributes:
        scene: the surfels.
        source: of them.
        confident: share of the subject's pixels whose depth stereo found and other photos confirm; None
            without stereo.
    """

    scene: GaussianScene
    source: Source
    confident: float | None = None

    @property
    def place(self) -> Place:
        """How far the surfels may have to move."""
        return place_of(self.source)


def place_of(source: Source) -> Place:
    """How far surfels of a source may have to move."""
    return {"depth": "in place", "stereo": "near"}.get(source, "anywhere")


def extent_of(views: Sequence[View]) -> float:
    """Size of a capture, world units: 1.1 x the median distance of the cameras to their median centre."""
    positions = np.stack([view.camera.position for view in views])
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    extent = float(_EXTENT_MARGIN * np.median(distance))
    if not extent > _SAME_PLACE * np.abs(positions).max():
        raise TronError("all cameras of the capture stand at one place", mend="photograph it from around it")
    return extent


def source_of(capture: Capture, settings: InitialSettings) -> Source:
    """Source of a capture's first surfels.

    Raises:
        TronError: the source asked for is not there.
    """
    has_depth = any(view.has("depth") for view in capture.train_views)
    if settings.source == "auto":
        return "points" if _dense(capture) else "depth" if has_depth else "stereo"
    if settings.source == "points" and capture.points is None:
        raise TronError("the capture has no points", mend="start from depth maps or random points")
    if settings.source == "depth" and not has_depth:
        raise TronError("no training view has a depth map", mend="start from points or random points")
    return settings.source


def beginning(
    capture: Capture,
    settings: InitialSettings,
    seed: int,
    most: int | None = None,
    track: Track = untracked,
) -> Beginning:
    """Surfels to begin with.

    Where stereo finds nothing, as on walls without texture, a line says so and the capture's points are
    taken, or random ones.

    Args:
        capture: its training views and points.
        settings: source, number and kernel.
        seed: root of all random numbers.
        most: maximum number of surfels; of more points as many are drawn.
        track: shows progress.

    Raises:
        TronError: the source asked for is not there.
    """
    source, confident = source_of(capture, settings), None
    of_maps = settings
    if most is not None and settings.count > _ABOUT * most:
        of_maps = settings.model_copy(update={"count": int(_ABOUT * most)})
    if source == "stereo":
        from tron.reconstruction.geometry.stereo import stereo_maps

        maps = stereo_maps(capture, settings.stereo, seed, track)
        confident = maps.confident
        if maps.views and confident >= _FEWEST:
            scene = surfels_from_depth(replace(capture, views=maps.views, test=frozenset()), of_maps, seed)
            return Beginning(scene, source, confident)
        source = "random" if capture.points is None else "points"
        log.warning(
            "stereo found a depth in %.1f %% of the pixels only: surfaces without texture, or poses that are "
            "wrong; beginning from %s",
            100 * confident,
            "random points" if source == "random" else "the capture's points",
        )
    if source == "depth":
        return Beginning(surfels_from_depth(capture, of_maps, seed), source)
    if source == "points" and capture.points is not None:
        points, colors = capture.points, capture.point_colors
        if most is not None and len(points) > most:
            draw = generator(seed, "reconstruction", "points")
            chosen = np.sort(draw.choice(len(points), most, replace=False))
            points, colors = points[chosen], None if colors is None else colors[chosen]
        return Beginning(surfels_at(points, colors, capture, settings, seed), source, confident)
    points = random_points(capture, min(settings.count, most or settings.count), seed)
    return Beginning(surfels_at(points, None, capture, settings, seed), source, confident)


def _dense(capture: Capture) -> bool:
    """Whether a capture's points are dense enough for surfels: on surfaces, not only on corners."""
    points = capture.points
    if points is None or len(points) < 4:
        return False
    spacing, some = measure_spacing(points), points[:: max(len(points) // _SOME, 1)]
    widths = [
        np.median(view.camera.project(some)[1].clip(0)) / view.camera.fx for view in capture.train_views
    ]
    return spacing <= _DENSE * float(np.median(widths))


def surfels_at(
    points: np.ndarray, colors: np.ndarray | None, capture: Capture, settings: InitialSettings, seed: int
) -> GaussianScene:
    """A round surfel at each point, as wide as the root mean square distance to its three neighbours.

    A surfel has one visible side. Nothing is known of the surface, so each faces a camera drawn at random
    from those that have it in their picture: neighbours then face all sides that anyone sees.

    Args:
        points: (N, 3) world.
        colors: (N, 3) display, or None for grey.
        capture: its training views.
        settings: opacity and kernel.
        seed: root of the draw.
    """
    count = len(points)
    if count < 4:
        raise TronError(f"{count} points are too few to begin with", mend="give more, or random points")
    distances = neighbour_distances(points)
    smallest = np.median(distances) * 1e-3 + 1e-7
    base = np.full((count, 3), 0.5) if colors is None else np.asarray(colors, np.float64)
    sh = np.zeros((count, SH_COUNT, 3))
    sh[:, 0] = rgb_to_dc(base)
    return GaussianScene(
        means=points,
        quats=quats_from_normals(_towards_cameras(points, capture.train_views, seed)),
        log_scales=np.log(np.maximum(distances, smallest))[:, None].repeat(2, axis=1),
        opacity_logits=np.full(count, logit(settings.opacity)),
        sh=sh,
        base_color=srgb_to_linear(base),
        roughness=np.full(count, 0.5),
        metallic=np.zeros(count),
        object_id=np.zeros(count, np.int32),
        kernel_degree=settings.kernel_degree,
        spacing=measure_spacing(points),
        up=capture.up,
    )


def _towards_cameras(points: np.ndarray, views: Sequence[View], seed: int) -> np.ndarray:
    """(N, 3) unit directions to a camera that has the point in its picture, drawn at random."""
    rng = generator(seed, "reconstruction", "facing")
    best = np.full(len(points), -1.0)
    chosen = np.zeros(len(points), int)
    for index, view in enumerate(views):
        within = pixels_of(view, points)[2]
        lot = np.where(within, 1.0, 0.0) + 0.5 * rng.random(len(points))
        chosen = np.where(lot > best, index, chosen)
        best = np.maximum(lot, best)
    positions = np.stack([view.camera.position for view in views])
    direction = positions[chosen] - points
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return np.where(length > 0, direction / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))


# Fractions of the distance to neighbouring surfels, measured for each kernel (conventions.md, 6).


def surfels_from_depth(capture: Capture, settings: InitialSettings, seed: int) -> GaussianScene:
    """About ``settings.count`` opaque surfels through the depth maps of the training views.

    Normals are the views' own where they have them, else those of the depth maps. Base color is the views'
    own, else the picture's, decoded from sRGB.

    Raises:
        TronError: no depth map holds a surface.
    """
    views = [view for view in capture.train_views if view.has("depth")]
    per_view = max(settings.count * _PIXELS_PER_SURFEL // len(views), 64)
    samples = [_gbuffer(view, per_view, seed) for view in views]
    return surfels_from_gbuffers(
        samples,
        count=settings.count,
        kernel_degree=settings.kernel_degree,
        up=capture.up.tolist(),
    )


def _gbuffer(view: View, most: int, seed: int) -> GBufferView:
    depth, image = view.read("depth"), view.read("image")
    position = view.camera.position + depth[..., None] * view.camera.rays()
    normal = view.read("normal") if view.has("normal") else normals_of_depth(view, depth)
    valid = (depth > 0) & ((normal * normal).sum(-1) > 0.25)
    if view.has("mask"):
        valid &= view.read("mask") > _SUBJECT
    valid &= view.believed()
    if valid.sum() > most:
        draw = generator(seed, "reconstruction", "depth", view.name)
        valid &= draw.random(valid.shape) < most / valid.sum()
    return GBufferView(
        camera=view.camera,
        position=position.astype(np.float32),
        normal=normal,
        base_color=view.read("base_color") if view.has("base_color") else srgb_to_linear(image),
        roughness=view.read("roughness") if view.has("roughness") else np.full_like(depth, 0.5),
        metallic=view.read("metallic") if view.has("metallic") else np.zeros_like(depth),
        rgb=image,
        valid=valid,
        object_id=np.zeros(depth.shape, np.int32),
    )


def normals_of_depth(view: View, depth: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 unit normals, world, towards the camera, of a depth map (H, W); 0 where unknown.

    Of the two neighbours in a row or column the one nearer in depth is taken, so that edges stay sharp.
    """
    points = view.camera.position + depth[..., None].astype(np.float64) * view.camera.rays()
    known = depth > 0
    across, along = (_difference(points, depth, known, axis) for axis in (1, 0))
    normal = np.cross(along, across)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1), 0)
    towards = -(normal * view.camera.rays()).sum(-1, keepdims=True)
    return np.where(known[..., None], np.sign(towards) * normal, 0).astype(np.float32)


def _difference(points: np.ndarray, depth: np.ndarray, known: np.ndarray, axis: int) -> np.ndarray:
    """Difference to the neighbour, of the two, that is nearer in depth; 0 where neither is known."""
    ahead, behind = np.roll(points, -1, axis) - points, points - np.roll(points, 1, axis)
    jump = {}
    for name, shift, edge in (("ahead", -1, -1), ("behind", 1, 0)):
        gap = np.abs(np.roll(depth, shift, axis) - depth)
        fine = np.roll(known, shift, axis) & known
        np.moveaxis(fine, axis, 0)[edge] = False
        jump[name] = np.where(fine, gap, np.inf)
    chosen = np.where((jump["ahead"] <= jump["behind"])[..., None], ahead, behind)
    found = np.isfinite(np.minimum(jump["ahead"], jump["behind"]))
    return np.where(found[..., None], chosen, 0)
