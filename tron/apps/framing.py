"""Camera paths around a scene that nobody has framed (:mod:`tron.framing`)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np

from tron import trajectories
from tron.cameras import Camera
from tron.framing import Surfels, find_subject, framed

TrajectoryName = Literal["orbit", "spiral", "oscillating", "still"]


def plan_cameras(
    scene: Surfels,
    trajectory: TrajectoryName,
    frames: int,
    *,
    width: int,
    height: int,
    fov_deg: float,
    distance: float = 1.0,
    **path: Any,
) -> list[Camera]:
    """A camera path around the scene's subject.

    Args:
        scene: the surfels, and which way is up.
        trajectory: name of a path in tron.trajectories.
        frames: number of cameras.
        width, height: pixels.
        fov_deg: horizontal field of view, degrees.
        distance: factor on the automatic distance.
        path: what the trajectory is told beside, such as its elevations.
    """
    subject = find_subject(scene)
    view = {"target": subject.centre, "up": scene.up, "width": width, "height": height, "fov_deg": fov_deg}

    def at(radius: float) -> list[Camera]:
        return getattr(trajectories, trajectory)(frames, radius=radius, **view, **path)

    return framed(subject, at, width=width, height=height, fov_deg=fov_deg, distance=distance)


def turn_cameras(cameras: list[Camera], rotation: np.ndarray) -> list[Camera]:
    """The same views of a world turned about its origin by a (3, 3) rotation."""
    turn = np.eye(4)
    turn[:3, :3] = rotation.T
    return [replace(camera, world_to_camera=camera.world_to_camera @ turn) for camera in cameras]
