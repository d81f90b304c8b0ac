"""Where things are put: turned and scaled about their foot, and stood upright on what lies below a point."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from tron.editing.views import Views
from tron.errors import TronError
from tron.framing import foot_height, upright
from tron.gaussians.edit import moved, scaled, with_kernel
from tron.gaussians.scene import GaussianScene

log = logging.getLogger(__name__)


def foot(scene: GaussianScene, which: np.ndarray) -> np.ndarray:
    """(3,) the point that surfels (M,) bool stand on: below the mean of their centres, at their lowest."""
    points, up = scene.means[which].astype(np.float64), scene.up
    middle = points.mean(0)
    return middle + (foot_height(points @ up, scene.opacity_logits[which]) - middle @ up) * up


def placed(
    scene: GaussianScene,
    which: np.ndarray,
    *,
    by: np.ndarray,
    turn_deg: float = 0.0,
    axis: np.ndarray | None = None,
    scale: float = 1.0,
    about: np.ndarray | None = None,
) -> GaussianScene:
    """The scene with some surfels scaled and turned about a point, then shifted; radiance turns with them.

    Args:
        scene: the surfels.
        which: (M,) bool.
        by: (3,) shift, world units.
        turn_deg: counter-clockwise seen from the axis' tip.
        axis: (3,) of any length, world; None: up.
        scale: factor on sizes and distances.
        about: (3,), world; None: their foot.
    """
    pivot = foot(scene, which) if about is None else about
    if scale != 1:
        scene = scaled(scene, which, scale, pivot)
    turn = None
    if turn_deg % 360:
        along = np.asarray(scene.up if axis is None else axis, np.float64)
        turn = Rotation.from_rotvec(np.radians(turn_deg) * along / np.linalg.norm(along)).as_matrix()
    return moved(scene, which, turn, by, pivot) if turn is not None or np.any(by) else scene


def surface_below(scene: GaussianScene, views: Views, point: np.ndarray) -> np.ndarray:
    """(3,) the point of the scene's surface straight below another; TronError where there is none."""
    at = np.asarray(point, np.float64)
    distance = views.below(scene, at)
    if distance is None:
        raise TronError(
            f"nothing lies below {at.tolist()}", mend="give a point above a surface, or standing: false"
        )
    return at - distance * scene.up


def fitted(other: GaussianScene, scene: GaussianScene) -> GaussianScene:
    """Another scene as surfels of this one: up is up, one kernel, normals with a sign where this has them."""
    turn = upright(scene.up).T @ upright(other.up)
    if not np.allclose(turn, np.eye(3)):
        other = other.rotated(turn)
    if other.kernel_degree != scene.kernel_degree:
        log.warning(
            "what is inserted has a kernel of degree %d, the scene %d: its surfels get another size",
            other.kernel_degree, scene.kernel_degree,
        )  # fmt: skip
        other = with_kernel(other, scene.kernel_degree)
    if scene.oriented and not other.oriented:
        log.warning("what is inserted has normals without a sign: they are turned outward from its middle")
        inward = ~other.looks_away(np.median(other.means, axis=0))
        other = replace(other.turned_over(inward), oriented=True)
    return other
