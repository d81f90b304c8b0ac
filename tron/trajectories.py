"""Camera paths around a target: the data engine's spiral and oscillation, an orbit, a stand, and keyframes.

Around a scene that nobody has framed, :func:`plan_cameras` finds target and distance (:mod:`tron.framing`).

Angles are in degrees. Azimuth turns counter-clockwise about ``up`` seen from its tip, and is measured from
the world's x axis where up is +z. Elevation is the angle above the plane through the target orthogonal to
``up``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NotRequired, TypedDict, Unpack

import numpy as np

from tron.cameras import Camera
from tron.errors import TronError
from tron.framing import Surfels, find_subject, framed, has_floor, outward

Vector = Sequence[float] | np.ndarray
Z_UP = (0.0, 0.0, 1.0)
TrajectoryName = Literal["orbit", "spiral", "oscillating", "still"]
FILM_FOV_DEG, HIGHEST_DEG = 40.0, 75.0
LOWEST_DEG = {True: 8.0, False: -30.0}
"""Elevation of the lowest camera around a scene with a floor, under which nothing is seen, and without."""


class View(TypedDict):
    """The subject of a path, and the images that its cameras take.

    Attributes:
        target: (3,) world point in the middle of every image.
        radius: distance of the cameras from the target, world units.
        width, height: pixels.
        fov_deg: horizontal field of view.
        up: (3,) world direction; +z if it is not given.
    """

    target: Vector
    radius: float
    width: int
    height: int
    fov_deg: float
    up: NotRequired[Vector]


def spiral(
    n: int,
    *,
    elevation_deg: tuple[float, float] = (10.0, 75.0),
    turns: float = 3.0,
    phase: float = 0.0,
    **view: Unpack[View],
) -> list[Camera]:
    """Wind around the target from the lower to the upper elevation, evenly over the sphere's area.

    Views used for reconstruction should neither crowd at the top nor miss a side; equal steps in the sine of
    the elevation are equal steps in area.

    Args:
        n: number of cameras.
        elevation_deg: of the first and the last camera, within (-90, 90).
        turns: windings from the first to the last camera.
        phase: azimuth of the first camera in degrees.
        view: what the path goes around.
    """
    fraction = _fractions(n)
    low, high = np.sin(np.radians(elevation_deg))
    elevation = np.degrees(np.arcsin(low + (high - low) * fraction))
    azimuth = phase + 360.0 * turns * fraction
    return _around(azimuth, elevation, **view)


def oscillating(
    n: int,
    *,
    elevation_deg: float = 28.0,
    amplitude_deg: float = 14.0,
    azimuth_deg: tuple[float, float] = (17.0, 338.0),
    swings: float = 1.5,
    **view: Unpack[View],
) -> list[Camera]:
    """Travel around the target while rising and sinking: the path of the benchmark's test clips.

    Args:
        n: number of cameras.
        elevation_deg: mean elevation.
        amplitude_deg: largest deviation from it.
        azimuth_deg: of the first and the last camera.
        swings: full up-and-down periods from the first to the last camera.
        view: what the path goes around.
    """
    fraction = _fractions(n)
    azimuth = azimuth_deg[0] + (azimuth_deg[1] - azimuth_deg[0]) * fraction
    elevation = elevation_deg + amplitude_deg * np.sin(2 * np.pi * swings * fraction)
    return _around(azimuth, elevation, **view)


def orbit(
    n: int,
    *,
    elevation_deg: float = 25.0,
    phase: float = 0.0,
    **view: Unpack[View],
) -> list[Camera]:
    """Go once around the target at one elevation; frame n would be frame 0 again, so the clip loops.

    Args: as in :func:`spiral`.
    """
    _fractions(n)
    azimuth = phase + 360.0 * np.arange(n) / n
    return _around(azimuth, np.full(n, elevation_deg), **view)


def still(
    n: int,
    *,
    elevation_deg: float = 25.0,
    phase: float = 0.0,
    **view: Unpack[View],
) -> list[Camera]:
    """Stay at the first camera of :func:`orbit`, one object n times: for clips in which only the light moves.

    Args: as in :func:`spiral`.
    """
    where = np.array([phase]), np.array([elevation_deg])
    return _around(*where, **view) * len(_fractions(n))


def keyframed(cameras: Sequence[Camera], n: int) -> list[Camera]:
    """Move through the given cameras in order, in n frames that include the first and the last.

    Rotations are interpolated on the sphere (slerp), positions and intrinsics linearly, at equal time from
    one keyframe to the next.

    Args:
        cameras: at least one; all of one image size.
        n: number of frames.

    Raises:
        TronError: no camera, or image sizes that differ.
    """
    if not cameras:
        raise TronError("a keyframed path needs at least one camera")
    first = cameras[0]
    if any((camera.width, camera.height) != (first.width, first.height) for camera in cameras):
        raise TronError("the cameras of a keyframed path must share one image size")
    if len(cameras) == 1:
        return [first for _ in _fractions(n)]
    keys = np.arange(len(cameras), dtype=np.float64)
    times = _fractions(n) * keys[-1]
    matrices = [camera.world_to_camera[:3, :3] for camera in cameras]
    from scipy.spatial.transform import Rotation, Slerp

    rotations = Slerp(keys, Rotation.from_matrix(matrices))(times)
    values = [(*camera.position, camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras]
    tracks = np.stack([np.interp(times, keys, track) for track in np.transpose(values)], axis=1)
    path = []
    for rotation, (x, y, z, *intrinsics) in zip(rotations.as_matrix(), tracks.tolist()):
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = -rotation @ (x, y, z)
        fx, fy, cx, cy = intrinsics
        path.append(Camera(fx, fy, cx, cy, first.width, first.height, matrix))
    return path


def _fractions(n: int) -> np.ndarray:
    """(n,) from 0 to 1, both included; a path of a single camera is its start."""
    if n < 1:
        raise TronError(f"a camera path needs at least one camera, not {n}")
    return np.arange(n) / max(n - 1, 1)


def _around(azimuth_deg: np.ndarray, elevation_deg: np.ndarray, **view: Unpack[View]) -> list[Camera]:
    target, radius = np.asarray(view["target"], dtype=np.float64), view["radius"]
    up = np.asarray(view.get("up", Z_UP), dtype=np.float64)
    image = {"up": up, "fov_deg": view["fov_deg"], "width": view["width"], "height": view["height"]}
    if np.abs(elevation_deg).max() >= 90:
        raise TronError("elevations of a camera path must stay between -90 and 90 degrees")
    if not radius > 0:
        raise TronError(f"radius of a camera path must be positive, not {radius}")
    positions = target + radius * outward(azimuth_deg, elevation_deg, up)
    return [Camera.look_at(position, target, **image) for position in positions]


_PATHS = {"orbit": orbit, "spiral": spiral, "oscillating": oscillating, "still": still}


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
        trajectory: name of a path of this module.
        frames: number of cameras.
        width, height: pixels.
        fov_deg: horizontal field of view, degrees.
        distance: factor on the automatic distance.
        path: what the trajectory is told beside, such as its elevations.
    """
    subject = find_subject(scene)
    view = {"target": subject.centre, "up": scene.up, "width": width, "height": height, "fov_deg": fov_deg}

    def at(radius: float) -> list[Camera]:
        return _PATHS[trajectory](frames, radius=radius, **view, **path)

    return framed(subject, at, width=width, height=height, fov_deg=fov_deg, distance=distance)


def turn_cameras(cameras: list[Camera], rotation: np.ndarray) -> list[Camera]:
    """The same views of a world turned about its origin by a (3, 3) rotation."""
    turn = np.eye(4)
    turn[:3, :3] = rotation.T
    return [replace(camera, world_to_camera=camera.world_to_camera @ turn) for camera in cameras]


def film_around(scene: Surfels, views: int, side: int) -> list[Camera]:
    """Cameras on a spiral around the scene's subject, of ``side`` x ``side`` pixels, to film all of it."""
    elevation_deg = (LOWEST_DEG[has_floor(scene)], HIGHEST_DEG)
    view = {"width": side, "height": side, "fov_deg": FILM_FOV_DEG}
    return plan_cameras(scene, "spiral", views, **view, elevation_deg=elevation_deg)


def film_with(cameras: Sequence[Camera], views: int, side: int) -> list[Camera]:
    """Some ``views`` of the cameras, evenly, or all where there are fewer; the longer sides are ``side``."""
    numbers = np.linspace(0, len(cameras) - 1, min(views, len(cameras))).round().astype(int)
    resized = []
    for camera in (cameras[number] for number in numbers):
        share = side / max(camera.width, camera.height)
        resized.append(
            camera.resized(max(round(share * camera.width), 1), max(round(share * camera.height), 1))
        )
    return resized
