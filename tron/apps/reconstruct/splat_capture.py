"""A file of splats as a capture: filmed by virtual cameras, with what they saw as photos and depth maps.

A plain 3DGS scan knows how it looks, not where its surfaces face nor what they are made of: its normals are
its shortest axes, with signs that mean nothing. Its pictures and median depths from many sides tell materials
and light, for its own surfels, which stay (:mod:`tron.reconstruction.materials.carried`), or for new ones,
whose surfaces are then found as from photos.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.errors import TronError
from tron.gaussians.formats.registry import check_header, named_as_splats, refuse_foreign
from tron.gaussians.scene import GaussianScene
from tron.scans import Scan
from tron.scans.camera_files import CAMERAS
from tron.seeds import generator
from tron.trajectories import film_around, film_with

if TYPE_CHECKING:
    from tron.apps.reconstruct.settings import SplatSettings
    from tron.reconstruction.progress import Track
    from tron.reconstruction.settings import FusionSettings

log = logging.getLogger(__name__)

INSIDE_FOV_DEG = 75.0
LOOKS = 8
"""Directions in which each place inside a room is filmed."""
INSIDE_ELEVATIONS_DEG = (-20.0, 10.0)
PLACES_TRIED = 2000
TRIMMED = 0.05
"""Share of the splats beyond each side of the box that places inside are drawn from."""
SOLID = 0.5
"""Opacity from which a pixel shows a surface."""
KEPT = 0.3
"""Share of thick pixels up to which surfels learnt anew were better on scans of development (17 and 23 %); of
thick ones (58 and 59 %) either was, and detail of large scans is the scan's own."""


def is_splats(path: Path) -> bool:
    """Whether a path is a file of splats by its name, packed ones included."""
    return path.is_file() and named_as_splats(path.name)


def film_splats(
    path: Path,
    settings: SplatSettings,
    up: Sequence[float] | None,
    test_every: int,
    fusion: FusionSettings,
    seed: int,
    track: Track,
) -> Capture:
    """The capture of a file of splats, in its own world.

    Images are display values with the splats' opacity as their mask. Depths, of training views alone, are
    those of the median hit where these views agree: they are fused, and rays walked to the surface.

    Args:
        path: a 3DGS, 2DGS or TRON PLY, or packed splats.
        settings: of the cameras.
        up: direction in the file's world; None: what the file says.
        test_every: each view of this distance is held out, from the first; 0 holds out none.
        fusion: of the depths.
        seed: root of the places inside.
        track: shows progress.

    Raises:
        TronError: the file holds no splats or is damaged; no free place is inside.
    """
    refuse_foreign(path)
    check_header(path)
    opened = Scan.open(
        path, up=up, surroundings=settings.surroundings, key="splats.surroundings", standing=False
    )
    content, shown, backdrop = opened.content, opened.shown, opened.backdrop
    filmed = opened.filmed if settings.cameras == "auto" else None
    if filmed is None:
        cameras = virtual_cameras(content, settings, seed)
    else:
        cameras = film_with(filmed, settings.views, settings.side)
        if path.with_name(CAMERAS).is_file():
            log.info("%s is filmed from where its photos were taken: %s", path, path.with_name(CAMERAS))
    from tron.reconstruction.film import film  # Mitsuba: not for --help

    kept = keeps_surfels(content, settings.geometry, filmed)
    views = film(content, cameras, track)
    if backdrop is not None:
        views = [_under_its_sky(view, shown, backdrop) for view in views]
    test = frozenset(view.name for view in views[::test_every]) if test_every else frozenset()
    agreed = iter(_agreeing([view for view in views if view.name not in test], fusion))
    views = [replace(view, depth=None) if view.name in test else next(agreed) for view in views]
    scan = content if kept else None
    return Capture(tuple(views), test, up=content.up, offset=content.offset, scan=scan)


def keeps_surfels(scene: GaussianScene, geometry: str, cameras: Sequence[Camera] | None) -> bool:
    """Whether a scan's own surfels get materials; else others are learnt from its film.

    Args:
        geometry: of the settings.
        cameras: that it was filmed with; None: around it.
    """
    if geometry != "auto":
        return geometry == "scan"
    from tron.relighting.proxy import thickness
    from tron.tracing import SurfelTracer

    share = thickness(SurfelTracer(scene), cameras)
    said = f"{share:.0%} of the scan's opaque pixels are thicker than a spacing"
    if share >= KEPT:
        log.info("%s: its own surfels get materials (splats.geometry=new learns others)", said)
        return True
    log.info("%s, few: others are learnt, in many minutes (splats.geometry=scan keeps its own)", said)
    return False


def virtual_cameras(scene: GaussianScene, settings: SplatSettings, seed: int) -> list[Camera]:
    """The cameras of the settings, those around the scene first."""
    outside = {"inside": 0, "both": settings.views // 2}.get(settings.cameras, settings.views)
    cameras = []
    if outside:
        cameras += film_around(scene, outside, settings.side)
    if inside := settings.views - outside:
        cameras += _inside(scene, inside, settings.side, seed)
    return cameras


def _inside(scene: GaussianScene, count: int, side: int, seed: int) -> list[Camera]:
    """Cameras at the freest places of the scene's box that lie far from one another."""
    low, high = scene.bounds(TRIMMED)
    drawn = generator(seed, "splats", "places").uniform(low, high, (PLACES_TRIED, 3))
    solid = scene.means[scene.opacities() > 0.5]
    if not len(solid):
        raise TronError("no splat is opaque, so nothing tells free space", mend="use splats.cameras=around")
    room = KDTree(solid).query(drawn)[0]
    places: list[np.ndarray] = []
    apart = room.copy()
    for _ in range(-(-count // LOOKS)):
        best = int(apart.argmax())
        places.append(drawn[best])
        apart = np.minimum(apart, np.linalg.norm(drawn - drawn[best], axis=1))
    east, north = _level(scene.up)
    cameras = []
    for number in range(count):
        place, look = places[number // LOOKS], number % LOOKS
        azimuth = 2 * np.pi * (look + 0.5 * (number // LOOKS)) / LOOKS
        elevation = np.radians(INSIDE_ELEVATIONS_DEG[look % 2])
        ahead = np.cos(azimuth) * east + np.sin(azimuth) * north
        direction = np.cos(elevation) * ahead + np.sin(elevation) * scene.up
        view = {"up": scene.up, "fov_deg": INSIDE_FOV_DEG, "width": side, "height": side}
        cameras.append(Camera.look_at(place, place + direction, **view))
    return cameras


def _level(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit directions (3,) across ``up`` and each other."""
    east = np.cross(np.eye(3)[np.abs(up).argmin()], up)
    east /= np.linalg.norm(east)
    return east, np.cross(up, east)


def _agreeing(views: Sequence[View], settings: FusionSettings) -> list[View]:
    """The views with the depths that they agree on, 0 elsewhere; without any where there is no surface."""
    from tron.tracing.fusion import DepthMap, empty_rays, fused_views  # Mitsuba: not for --help

    maps = []
    for view in views:
        subject, depth = view.read("mask") > SOLID, view.read("depth")
        maps.append(DepthMap(view.camera, depth, subject & (depth > 0), empty_rays(subject)))
    agreed = fused_views(maps, settings.truncation, settings.sigma, settings.most_voxels)
    if not agreed:
        return [replace(view, depth=None) for view in views]
    return [replace(view, depth=depth) for view, (depth, _) in zip(views, agreed)]


def _under_its_sky(view: View, shown: GaussianScene, backdrop: np.ndarray) -> View:
    """The view of the content with what surrounds it, which is its sky where that is to be seen."""
    from tron.reconstruction.film import straight_color
    from tron.tracing import SurfelTracer  # Mitsuba: not for --help

    # Each camera sees the side that it is on, but of a backdrop the inside alone.
    if not shown.oriented:
        shown = shown.turned_over(shown.looks_away(view.camera.position) & ~backdrop)
    seen = SurfelTracer(shown).gbuffer(view.camera).numpy()
    sky = np.clip(seen["opacity"], 0, 1) * (1 - view.read("mask"))
    return replace(view, image=straight_color(seen), sky_mask=sky)
