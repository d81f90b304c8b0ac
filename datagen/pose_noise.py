"""Poses and points as structure from motion would give them: a little off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from tron.cameras import Camera


def disturbed(camera: Camera, rotation_deg: float, translation: float, rng: np.random.Generator) -> Camera:
    """The camera turned and moved by normal errors.

    Args:
        camera: the true one.
        rotation_deg: standard deviation of rotation about each of its axes, degrees.
        translation: standard deviation of its place along each axis, world units.
        rng: source of the errors; three and three are drawn.
    """
    turn = Rotation.from_rotvec(rng.normal(0.0, rotation_deg, 3), degrees=True).as_matrix()
    position = camera.position + rng.normal(0.0, translation, 3)
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ camera.world_to_camera[:3, :3]
    matrix[:3, 3] = -matrix[:3, :3] @ position
    return replace(camera, world_to_camera=matrix)
