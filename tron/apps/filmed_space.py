"""Cameras that a scene was filmed with, and camera paths between them.

Beside and behind the photos there is nothing to see but guesses: surfels were learnt from where photos were
taken.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tron.apps.camera_files import cameras_of
from tron.cameras import Camera, focus_of
from tron.storage import write_atomic
from tron.trajectories import keyframed

if TYPE_CHECKING:
    from tron.captures import View

CAMERAS = "cameras.json"

_AROUND_DEG = 60.0
_KERNEL_DEG = 15.0


def write_cameras(folder: Path, views: Sequence[View]) -> None:
    """Write cameras.json: the views' cameras in their order, for ``tron-relight cameras=``.

    A clip has one size, so that all have that of the most of them: others are cut or continued about their
    middle, at their own focal length.
    """
    (width, height), _ = Counter((v.camera.width, v.camera.height) for v in views).most_common(1)[0]
    cameras = [_framed(view.camera, width, height).to_dict() for view in views]
    content = {"names": [view.name for view in views], "cameras": cameras}
    write_atomic(folder / CAMERAS, json.dumps(content, indent=1) + "\n")


def filmed_cameras(scene: Path) -> list[Camera] | None:
    """Cameras that a scene was filmed with, in its world, if a file beside it says so; else None.

    Raises:
        TronError: the file holds no cameras.
    """
    path = scene.with_name(CAMERAS)
    return cameras_of(path) if path.is_file() else None


def filmed_orbit(
    filmed: Sequence[Camera],
    n: int,
    *,
    up: np.ndarray,
    width: int,
    height: int,
    fov_deg: float,
    distance: float = 1.0,
) -> list[Camera]:
    """A path that loops, from where the photos were taken.

    Around what the photos look at if they were taken from all sides; to and fro from the middle, slowing
    down at the ends, if they leave a gap of more than 60 degrees. Height, distance and what is looked at
    are, for each direction, those of the photos taken from about there (means with a Gaussian of 15
    degrees), so that the path lies between them. Where photos look outwards, as in a room, it goes through
    their cameras in order.

    Args:
        filmed: at least one camera.
        n: number of frames.
        up: (3,) unit, world.
        width, height: pixels.
        fov_deg: horizontal field of view.
        distance: factor on the distance to what is looked at.
    """
    image = {"up": up, "width": width, "height": height, "fov_deg": fov_deg}
    focus, outward = focus_of([camera.camera_to_world for camera in filmed])
    places = np.stack([camera.position for camera in filmed])
    axes = np.stack([camera.forward for camera in filmed])
    if outward:
        keys = [Camera.look_at(place, place + axis, **image) for place, axis in zip(places, axes)]
        return keyframed(keys, n)
    east, north = _level(up)
    offsets = places - focus
    azimuth = np.degrees(np.arctan2(offsets @ north, offsets @ east))
    seen = places + np.maximum(((focus - places) * axes).sum(1), 0)[:, None] * axes
    height_of, reach = offsets @ up, np.hypot(offsets @ east, offsets @ north)
    cameras = []
    for angle in _angles(azimuth, n):
        apart = (azimuth - angle + 180) % 360 - 180
        # Relative to the nearest, so that no sum of weights vanishes.
        weights = np.exp(-0.5 * (apart**2 - (apart**2).min()) / _KERNEL_DEG**2)
        weights /= weights.sum()
        out = np.cos(np.radians(angle)) * east + np.sin(np.radians(angle)) * north
        place, target = focus + (weights @ reach) * out + (weights @ height_of) * up, weights @ seen
        cameras.append(Camera.look_at(target + distance * (place - target), target, **image))
    return cameras


def _angles(azimuth: np.ndarray, n: int) -> np.ndarray:
    """(n,) degrees: all around, or to and fro over the arc that holds all azimuths."""
    ordered = np.sort(azimuth % 360)
    gaps = np.diff(ordered, append=ordered[0] + 360)
    widest = int(gaps.argmax())
    if gaps[widest] < _AROUND_DEG:
        return 360 * np.arange(n) / n
    first, span = ordered[(widest + 1) % len(ordered)], 360 - gaps[widest]
    return first + span * (0.5 + 0.5 * np.sin(2 * np.pi * np.arange(n) / n))


def _level(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit directions at right angles to up and to one another, right-handed with it."""
    east = np.cross((0.0, 1.0, 0.0) if abs(up[1]) < 0.9 else (0.0, 0.0, 1.0), up)
    east /= np.linalg.norm(east)
    return east, np.cross(up, east)


def _framed(camera: Camera, width: int, height: int) -> Camera:
    dx, dy = (width - camera.width) / 2, (height - camera.height) / 2
    return replace(camera, cx=camera.cx + dx, cy=camera.cy + dy, width=width, height=height)
