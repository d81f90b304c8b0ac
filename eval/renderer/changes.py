"""Change of pictures against the truth's: sums over pixels, from which correlation and slope follow.

An occluder moves between two frames, camera and light stand still. Where the surface stayed, what changes is
the light that arrives: its shadow and what bounces off it. x is the truth's change of a displayed value, y
that of a method. Correlation is Pearson's; the slope is that of the least-squares line of y over x,
cov(x, y) / var(x).
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation

from tron.shards.schema import Clip

SURFACE = ("depth_ref", "normal_ref", "base_color_ref")
"""Members that say whether a pixel's surface stayed."""
SAME_DEPTH = 1e-3
"""Largest relative difference of distances of a surface that stayed."""
SAME_NORMAL = 1e-3
"""Largest 1 - cosine of its normals."""
SAME_COLOR = 5e-3
"""Largest difference of its base color, linear; half floats round by 5e-4 at most."""


def stayed(clip: Clip, before: int, now: int) -> np.ndarray:
    """(H, W) bool: foreground in two frames whose true depth, normal and base color are unchanged.

    The eight pixels around have not changed either: a pixel's picture gathers light from half a pixel beyond
    its centre and more, so that beside a silhouette that moves it shows the occluder, not its shadow.
    """
    frames = {name: clip.frames[name] for name in (*SURFACE, "foreground")}
    (depth, other), (normal, turned), (color, dyed), (solid, there) = (
        (images[now], images[before]) for images in frames.values()
    )
    same = np.abs(depth - other)[..., 0] <= SAME_DEPTH * np.maximum(other[..., 0], 1e-6)
    same &= (normal * turned).sum(-1) >= 1 - SAME_NORMAL
    same &= np.abs(color - dyed).max(-1) <= SAME_COLOR
    now_solid, then_solid = solid[..., 0] > 0.5, there[..., 0] > 0.5
    same |= ~now_solid & ~then_solid  # sky has no normal
    changed = np.asarray(binary_dilation(~same, np.ones((3, 3), bool)), bool)
    return ~changed & now_solid & then_solid


def change_sums(truth: np.ndarray, ours: np.ndarray) -> np.ndarray:
    """(6,) float64: n and sums of x, y, xx, xy, yy over values of any shape."""
    x, y = (np.asarray(each, np.float64).ravel() for each in (truth, ours))
    return np.array([x.size, x.sum(), y.sum(), x @ x, x @ y, y @ y])


def correlation(sums: np.ndarray) -> np.ndarray:
    """Correlation from sums (..., 6); 0 where one side never varies."""
    _, var_x, var_y, cov = _moments(sums)
    spread = np.sqrt(np.maximum(var_x * var_y, 0))
    return np.divide(cov, spread, out=np.zeros_like(cov), where=spread > 1e-15)


def slope(sums: np.ndarray) -> np.ndarray:
    """Slope from sums (..., 6); 0 where the truth never varies."""
    _, var_x, _, cov = _moments(sums)
    return np.divide(cov, var_x, out=np.zeros_like(cov), where=var_x > 1e-15)


def slope_error(sums: np.ndarray) -> np.ndarray:
    """Distance of the slope from 1."""
    return np.abs(slope(sums) - 1)


def _moments(sums: np.ndarray) -> tuple[np.ndarray, ...]:
    count = np.maximum(sums[..., 0], 1)
    mean_x, mean_y = sums[..., 1] / count, sums[..., 2] / count
    var_x, var_y = sums[..., 3] / count - mean_x**2, sums[..., 5] / count - mean_y**2
    return count, np.asarray(var_x), np.asarray(var_y), np.asarray(sums[..., 4] / count - mean_x * mean_y)
