"""Cameras of a scene's photos, from a file or from the splats; camera paths between them, and from files.

Either the cameras or the scene may have had its large coordinates taken away: :func:`in_frame_of`.
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tron.cameras import Camera, focus_of
from tron.errors import TronError
from tron.gaussians.ply import header_elements
from tron.io.cameras.registry import UPRIGHT, cameras_of
from tron.io.local_frame import ORIGIN, moved_cameras
from tron.storage import write_atomic
from tron.trajectories import keyframed, turn_cameras

if TYPE_CHECKING:
    from tron.captures import View
    from tron.gaussians.scene import GaussianScene

log = logging.getLogger(__name__)

CAMERAS = "cameras.json"
_AROUND_DEG = 60.0
_KERNEL_DEG = 15.0
_ELEMENTS = {"extrinsic", "intrinsic", "image_size"}
"""Of the PLYs of SHARP (apple/ml-sharp, save_ply), beside their splats."""
_FEWEST = 500
_AHEAD, _WIDEST = 0.99, 1.2
"""Share of the splats before the camera, and the tangent within which 95 % of them are seen."""
_SIZES, _SHELL = 0.4, 0.05
"""Deviation of the logarithm of sizes over distances; and how far apart the logarithms of distances in one
direction are, in the median of all directions."""
_PER_CELL = 6
_SHARE = 0.98
_BASELINE, _PLACES, _SIDE = 0.04, 8, 512
"""Cameras stand around the photo's, this share of the median distance away from it."""


def read_cameras(path: Path, width: int, height: int, fps: float = 24.0) -> list[Camera]:
    """Cameras of a file (:func:`tron.io.cameras.registry.cameras_of`), resized.

    Raises:
        TronError: as there, or they have another aspect ratio.
    """
    cameras = cameras_of(path, (width, height), fps)
    for camera in cameras:
        if abs(camera.width * height - camera.height * width) > max(width, height):
            fit = frame_size((camera.width, camera.height), max(width, height))
            raise TronError(
                f"cameras are {camera.width} x {camera.height}, frames {width} x {height}",
                path,
                f"choose the same aspect ratio, such as width={fit[0]} height={fit[1]}",
            )
    return [camera.resized(width, height) for camera in cameras]


def frame_size(shape: tuple[int, int], longer: int) -> tuple[int, int]:
    """Return even width and height of a frame: aspect ratio of ``shape``, longer side ``longer``, pixels."""
    width, height = (max(8, 2 * round(longer * side / max(shape) / 2)) for side in shape)
    return width, height


def in_frame_of(offset: np.ndarray, cameras: Sequence[Camera], path: Path) -> list[Camera]:
    """Shift cameras of a file into the local frame of a scene, in float64.

    A file that says its own ``offset``, as cameras.json and relight.json of a scene with one do, holds
    positions about it. One that says none holds coordinates of the map or of the local frame: whichever its
    cameras are nearer to. Cameras of modellers are of the local frame.

    Args:
        offset: (3,) of the scene, zero where nothing was taken away from it.
        cameras: of the file.
        path: the file.

    Raises:
        TronError: its offset is not three finite numbers.
    """
    if path.suffix.lower() in UPRIGHT:
        return list(cameras)
    own = _stated_offset(path) if path.suffix.lower() == ".json" else None
    if own is None:
        middle = np.median([camera.position for camera in cameras], axis=0)
        own = np.zeros(3) if np.linalg.norm(middle - offset) < np.linalg.norm(middle) else offset
    return moved_cameras(cameras, own - offset)


def stated(offset: np.ndarray) -> dict[str, list[float]]:
    """Return the JSON entry for an offset (3,); empty if the offset is zero."""
    return {"offset": [float(value) for value in offset]} if np.any(offset) else {}


def _stated_offset(path: Path) -> np.ndarray | None:
    """(3,) float64 offset that a file of cameras states, if it does."""
    content = json.loads(path.read_text("utf-8"))
    if not isinstance(content, dict) or content.get("offset") is None:
        return None
    try:
        offset = np.array(content["offset"], np.float64)
    except (TypeError, ValueError):
        offset = np.empty(0)
    if offset.shape != (3,) or not np.isfinite(offset).all():
        raise TronError("offset is not three finite numbers", path)
    return offset


def write_cameras(folder: Path, views: Sequence[View], offset: np.ndarray = ORIGIN) -> None:
    """Write cameras.json: the views' cameras in their order, for ``tron-relight cameras=``.

    A clip has one size, so that all have that of the most of them: others are cut or continued about their
    middle, at their own focal length. An offset (3,), what was taken away from large coordinates, is kept.
    """
    (width, height), _ = Counter((v.camera.width, v.camera.height) for v in views).most_common(1)[0]
    cameras = [_framed(view.camera, width, height).to_dict() for view in views]
    content = {"names": [view.name for view in views], **stated(offset), "cameras": cameras}
    write_atomic(folder / CAMERAS, json.dumps(content, indent=1) + "\n")


def filmed_cameras(scene: Path, offset: np.ndarray = ORIGIN) -> list[Camera] | None:
    """Return the cameras in ``cameras.json`` beside a scene with an offset (3,); None if it is missing.

    Raises:
        TronError: the file holds no cameras.
    """
    path = scene.with_name(CAMERAS)
    return in_frame_of(offset, cameras_of(path), path) if path.is_file() else None


def filmed_with(
    path: Path, turn: np.ndarray, offset: np.ndarray, scene: GaussianScene | None = None
) -> list[Camera] | None:
    """Return the cameras of a scene's photos, in the world turned by ``turn``; None if they are not known.

    A ``scene`` in that world that was made from one photo gives cameras even without a file beside it.
    """
    try:
        filmed = filmed_cameras(path, offset)
    except TronError as error:
        log.warning("%s; the scene is filmed and orbited without it", error)
        return None
    if filmed is not None:
        return turn_cameras(filmed, turn)
    return None if scene is None else _of_one_view(path, scene, turn)


def _of_one_view(path: Path, scene: GaussianScene, turn: np.ndarray) -> list[Camera] | None:
    """Cameras about where a scan that was made from one photo was seen from, the photo's first; else None.

    Such scans, as Apple's SHARP makes them, keep the photo's camera at the origin, that looks along +z, x
    right and y down. From behind they are the inside of a shell, and cameras around them would film that.

    Args:
        path: the scan's file.
        scene: what it holds, turned by ``turn`` (3, 3).
        turn: from the file's frame to that of the scene and of the cameras.
    """
    if scene.offset.any():
        return None
    places = scene.means.astype(np.float64) @ turn  # in the file's frame
    if not (header_elements(path) >= _ELEMENTS or _one_shell(places, scene.scales().max(1))):
        return None
    ahead = places[places[:, 2] > 0]
    tangents = np.quantile(np.abs(ahead[:, :2]) / ahead[:, 2:], _SHARE, axis=0).clip(0.05, 3)
    distance = float(np.median(ahead[:, 2]))
    width = round(_SIDE * min(1, tangents[0] / tangents[1]))
    view = {
        "up": turn @ (0, -1, 0), "fov_deg": float(2 * np.degrees(np.arctan(tangents[0]))),
        "width": max(width, 16), "height": max(round(width * tangents[1] / tangents[0]), 16),
    }  # fmt: skip
    target = turn @ (0, 0, distance)
    angles = 2 * np.pi * np.arange(_PLACES) / _PLACES
    around = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1) * _BASELINE * distance
    log.warning(
        "%s was made from one view: what that did not see is not there, and light comes in from behind; "
        "it is filmed from there (cameras.json beside it would say otherwise)", path,
    )  # fmt: skip
    return [Camera.look_at(turn @ place, target, **view) for place in (np.zeros(3), *around)]


def _one_shell(places: np.ndarray, sizes: np.ndarray) -> bool:
    """Whether splats lie in one layer about the origin, before +z, of sizes that grow with the distance.

    Args:
        places: (M, 3) in the file's frame.
        sizes: (M,) the larger of their standard deviations.
    """
    if len(places) < _FEWEST or (places[:, 2] > 0).mean() < _AHEAD:
        return False
    ahead = places[:, 2] > 0
    places, sizes = places[ahead], sizes[ahead]
    seen = places[:, :2] / places[:, 2:]
    if np.quantile(np.abs(seen).max(1), 0.95) > _WIDEST:
        return False
    distances = np.log(np.linalg.norm(places, axis=1))
    if np.std(np.log(sizes) - distances) > _SIZES:
        return False
    side = max(int(np.sqrt(len(places) / _PER_CELL)), 4)
    low, high = np.quantile(seen, [0.01, 0.99], axis=0)
    cells = np.clip((seen - low) / (high - low).clip(1e-9) * side, 0, side - 1).astype(int) @ (side, 1)
    order = np.lexsort((distances, cells))
    starts = np.flatnonzero(np.diff(cells[order], prepend=-1))
    ends = np.append(starts[1:], len(order)) - 1
    several = ends > starts
    apart = distances[order[ends[several]]] - distances[order[starts[several]]]
    return bool(several.sum() > 8 and np.median(apart) < _SHELL)


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
    """Plan a path between the cameras of the photos.

    Around what the photos look at if they were taken from all sides, which loops; once from one end to the
    other, slowing down there, if they leave a gap of more than 60 degrees. Height, distance and what is
    looked at are, for each direction, those of the photos taken from about there (means with a Gaussian of 15
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
    """(n,) degrees: all around, or once over the arc that holds all azimuths; its middle where n is 1."""
    ordered = np.sort(azimuth % 360)
    gaps = np.diff(ordered, append=ordered[0] + 360)
    widest = int(gaps.argmax())
    if gaps[widest] < _AROUND_DEG:
        return 360 * np.arange(n) / n
    first, span = ordered[(widest + 1) % len(ordered)], 360 - gaps[widest]
    return first + span * (0.5 - 0.5 * np.cos(np.pi * (np.arange(n) + 0.5) / n))


def _level(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit directions at right angles to up and to one another, right-handed with it."""
    east = np.cross((0.0, 1.0, 0.0) if abs(up[1]) < 0.9 else (0.0, 0.0, 1.0), up)
    east /= np.linalg.norm(east)
    return east, np.cross(up, east)


def _framed(camera: Camera, width: int, height: int) -> Camera:
    dx, dy = (width - camera.width) / 2, (height - camera.height) / 2
    return replace(camera, cx=camera.cx + dx, cy=camera.cy + dy, width=width, height=height)
