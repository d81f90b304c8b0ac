"""Up direction of a scene, from how it was photographed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tron.cameras import Camera

_STEPS = 20
_ROLL = 0.003
_SIDEWAYS = 0.9
_FLAT = 0.1


def estimate_up(cameras: Sequence[Camera]) -> np.ndarray:
    """Estimate the world's up direction, (3,) float64 unit, from cameras that a person held.

    People turn and tilt a camera but seldom roll it: its x axis stays level, and its y axis points up on
    average. Three cases:

    - Cameras' up axes agree on the whole. Up is where the robust (L1) mean of these axes and the level x axes
      meet: it minimises ``sum_i w_i (x_i . u)^2 + r |u - m|^2`` over directions u, with m the mean, r =
      0.003 and weights w that spare rolled cameras. Cameras that all look down on one side of a table pull
      m over, but not x. Where x axes say nothing, since all are parallel, m decides.
    - Up axes cancel while x axes agree: the photos lie on their side, as a phone held upright stores them.
      The x axis is then vertical, with the sign that has the cameras look down on average.
    - Neither: seen from a drone, or rolled at will. If the cameras' positions lie in a plane, up is its
      normal, on the side of the mean up axis or, where that vanishes, against the view; else the mean up
      axis.
    """
    rights = np.stack([camera.camera_to_world[:3, 0] for camera in cameras])
    ups = np.stack([camera.up for camera in cameras])
    backward = -np.mean([camera.forward for camera in cameras], axis=0)
    mean_up, mean_right = _robust_mean(ups), _robust_mean(rights)
    agreement = np.linalg.norm(ups.mean(0))
    if agreement < 0.3 and np.linalg.norm(rights.mean(0)) > _SIDEWAYS:
        return _level(mean_right * _sign(mean_right @ backward), ups)
    if agreement >= 0.3:
        return _level(mean_up, rights)
    positions = np.stack([camera.position for camera in cameras])
    _, spread, axes = np.linalg.svd(positions - positions.mean(0), full_matrices=False)
    if len(spread) == 3 and spread[2] < _FLAT * spread[1]:
        reference = mean_up @ axes[2] if agreement > 0.1 else backward @ axes[2]
        return axes[2] * _sign(reference)
    return mean_up


def _robust_mean(axes: np.ndarray) -> np.ndarray:
    """Unit direction with the least sum of distances to unit axes (N, 3), by reweighting (Weiszfeld)."""
    mean = _unit(axes.mean(0))
    for _ in range(_STEPS):
        weights = 1 / np.maximum(np.linalg.norm(axes - mean, axis=1), 1e-3)
        mean = _unit(weights @ axes)
    return mean


def _level(mean: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Refine an up direction by axes (N, 3) that ought to be level, sparing those that are not."""
    up = mean
    for _ in range(_STEPS):
        weights = 1 / np.maximum(np.abs(level @ up), 0.02)
        weights /= weights.sum()
        scatter = (level * weights[:, None]).T @ level
        up = _unit(np.linalg.solve(scatter + _ROLL * np.eye(3), _ROLL * mean))
    return up


def _unit(vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])


def _sign(value: float) -> float:
    return -1.0 if value < 0 else 1.0
