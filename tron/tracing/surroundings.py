"""Surroundings: splats far around the content that shut out the light, such as a shell of sky around a scan.

Outdoor scans paint the sky onto splats far away. Under another light these act as a lid that no ray from the
content can pass. Three properties tell them from walls, hills and strays:

- a gap: they are several times as far from the middle as the content, with next to nothing in between. In a
  room, the floor bridges the gap to the walls.
- few and large: they are a minor share of the splats, each larger than the content's. Scanned walls are not.
- overhead: rays from the content to directions well above the horizon end at them. So hills and strays are
  kept, and so is everything much nearer than the ends of those rays.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.gaussians.edit import subset
from tron.gaussians.scene import GaussianScene
from tron.runtime import lanes
from tron.seeds import generator
from tron.tracing.tracer import SurfelTracer

GAP = 3.0
"""Least ratio of the surroundings' distance from the middle to the content's."""
CLEAR = 1.5
"""The gap begins at this many times the distance that holds the content."""
BRIDGED = 0.02
"""Largest area of splats within the gap, as a share of the surroundings' area: a floor leads to walls."""
COVERED = 0.1
"""Largest area of splats within the gap, as a share of the level ring that spans it: a floor covers 0.4."""
MOST = 0.6
"""Largest share of all splats that can be surroundings."""
LARGER = 2.0
"""Least ratio of their median standard deviation to the content's."""
OVERHEAD = 0.4
"""Least share of the directions overhead that they block."""
LOWEST_DEG = 30.0
"""Least elevation of a direction overhead; distant hills are lower."""
NEAREST = 0.6
"""Least distance of a surrounding splat, over the distance at which rays end."""
_SOLID = 0.5
_FEWEST = 12
_ORIGINS, _DIRECTIONS = 8, 128


def find_surroundings(scene: GaussianScene) -> np.ndarray:
    """(M,) bool: surfels that surround the content and shut out the light; in most scenes, none.

    The cost is a sort of distances and, only if there is a gap, 1,024 rays.

    Args:
        scene: the surfels, world, and which way is up.
    """
    none = np.zeros(len(scene), bool)
    solid = scene.opacities() > _SOLID
    if solid.sum() < 2 * _FEWEST:
        return none
    middle = np.median(scene.means[solid].astype(np.float64), axis=0)
    distance = np.linalg.norm(scene.means - middle, axis=1)
    size = scene.scales().max(axis=1)
    content = _content_radius(distance[solid], size[solid])
    if content is None:
        return none
    outer = distance > content
    reached = _reached(scene, outer, middle)
    if reached is None:
        return none
    return distance > max(NEAREST * reached, content)


def _content_radius(distance: np.ndarray, size: np.ndarray) -> float | None:
    """Distance from the middle that encloses the content, if a gap lies beyond it; else None.

    Args:
        distance: (N,) of surfels from the middle. size: (N,) their larger standard deviations.
    """
    order = np.argsort(distance)
    ordered, area = distance[order], np.append(0, np.cumsum(np.square(size[order])))
    count = len(ordered)
    extent = ordered[int((1 - MOST) * count) : count - _FEWEST + 1]
    outer = np.searchsorted(ordered, CLEAR * extent)
    extent, outer = extent[outer <= count - _FEWEST], outer[outer <= count - _FEWEST]
    middle = ordered[(outer + count) // 2]
    near = np.maximum(np.searchsorted(ordered, NEAREST * middle), outer)
    between = area[near] - area[outer]
    ring = np.pi * (np.square(ordered[near]) - np.square(CLEAR * extent))
    empty = (between <= BRIDGED * (area[-1] - area[near])) & (between <= COVERED * ring)
    gaps = np.flatnonzero((middle >= GAP * np.maximum(extent, 1e-12)) & empty)
    if not len(gaps):
        return None
    split = outer[gaps[0]]
    if np.median(size[order[split:]]) < LARGER * np.median(size[order[:split]]):
        return None
    return float(CLEAR * extent[gaps[0]])


def _reached(scene: GaussianScene, outer: np.ndarray, middle: np.ndarray) -> float | None:
    """Median distance at which overhead rays end at the outer surfels; None if too few do."""
    rng = generator(0, "surroundings")
    near = np.flatnonzero(~outer & (scene.opacities() > _SOLID))
    origins = np.vstack([middle, scene.means[rng.choice(near, _ORIGINS - 1)]]).astype(np.float64)
    height = rng.uniform(np.sin(np.radians(LOWEST_DEG)), 1, (_ORIGINS, _DIRECTIONS))
    turn = rng.uniform(0, 2 * np.pi, (_ORIGINS, _DIRECTIONS))
    east = np.cross(np.eye(3)[np.abs(scene.up).argmin()], scene.up)
    east /= np.linalg.norm(east)
    level = np.sqrt(1 - height**2)
    frame = np.stack([east, np.cross(scene.up, east), scene.up])
    ways = np.stack([level * np.cos(turn), level * np.sin(turn), height], -1) @ frame
    start = np.repeat(origins, _DIRECTIONS, axis=0)
    far = subset(scene, outer).facing(middle)
    surface = SurfelTracer(far).trace(lanes(mi.Point3f, start), lanes(mi.Vector3f, ways.reshape(-1, 3)))
    dr.eval(surface.depth)
    depth = surface.depth.numpy()
    ended = depth > 0
    return float(np.median(depth[ended])) if ended.mean() >= OVERHEAD else None
