"""Surroundings: splats far around the content that shut out the light, such as a shell of sky around a scan.

Scans taken outdoors paint the sky that they saw onto splats far away. Under another light they are a lid: no
ray from the content gets past them. What tells them from walls, hills and strays:

- a gap: they are several times as far from the middle as what lies within, and next to nothing is between.
  A room's floor leads to its walls.
- they are few and large: a share of the splats, each larger than the content's. Walls are what was scanned.
- they are overhead: rays from the content to directions well above the horizon end at them. Hills stay, and
  so do strays, and whatever lies much nearer than where those rays end.
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
"""Least ratio of distances from the middle: of the surroundings over that of the content."""
CLEAR = 1.5
"""The gap begins at this many times the distance that holds the content."""
BRIDGED = 0.02
"""Largest area of splats within the gap, as a share of that of the surroundings: a floor leads to walls."""
COVERED = 0.1
"""Largest area of them as a share of a level ring from end to end of the gap: a floor covers 0.4."""
MOST = 0.6
"""Largest share of the splats."""
LARGER = 2.0
"""Least ratio of their median standard deviation to that of the content."""
OVERHEAD = 0.4
"""Least share of the directions overhead that they shut."""
LOWEST_DEG = 30.0
"""Elevation from which on a direction is overhead: farther hills are lower."""
NEAREST = 0.6
"""Distance of what belongs to them, over that at which rays end."""
_SOLID = 0.5
_FEWEST = 12
_ORIGINS, _DIRECTIONS = 8, 128


def find_surroundings(scene: GaussianScene) -> np.ndarray:
    """(M,) bool: surfels that surround the content and shut out the light; none of them in most scenes.

    Costs a sort of distances; rays, 1,024 of them, only where there is a gap.

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
    """Distance from the middle within which the content is, where a gap lies beyond it; None where none does.

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
    """Median distance at which rays overhead end at the outer surfels; None where too few do."""
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
