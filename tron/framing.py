"""Framing of a scene that nobody has framed: what to look at, from where, and from how far.

The subject is what stands on the floor, where there is one: a floor often holds most of the surfels, and a
view that shows all of it shows little else. Strays are left out by quantiles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from tron.errors import TronError

Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From a world that is z up to one that is y up, as glTF's and most of USD's."""
# Fraction of the subject's surfels that may lie outside the frame.
STRAYS = 0.01
# Empty border around the subject, as a fraction of the image's sides.
BORDER = 0.06
LOWEST = 0.002
"""Share of the opaque surfels that may lie below what a scene stands on: strays."""
_OPAQUE_LOGIT = 0.0
# A floor is flat: its surfels look up within this cosine and lie within this many spacings of one height.
_LEVEL_COSINE = 0.95
_FLOOR_SPACINGS = 3.0
_FLOOR_SHARE = 0.2
_SUBJECT_SHARE = 0.005
# Enough points and cameras to find a distance by; a camera comes no nearer than this many radii.
_PROBES = 2000
# Parts that stand out are sought up to so many radii, in cells of that share of one, each with some surfels.
_REACH, _CELLS, _CROWD = 1.5, 24, 3
_PROBE_CAMERAS = 24
_NEAREST = 1.2


class Surfels(Protocol):
    """A scene as far as framing goes: :class:`tron.gaussians.GaussianScene`.

    Attributes:
        means: (M, 3) centres, world.
        spacing: between neighbours, world units.
        up: (3,) unit.
    """

    means: np.ndarray
    spacing: float
    up: np.ndarray

    def __len__(self) -> int: ...
    def normals(self) -> np.ndarray: ...


class Viewer(Protocol):
    """A camera as far as framing goes: :class:`tron.cameras.Camera`."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...


V = TypeVar("V", bound=Viewer)


@dataclass(frozen=True)
class Subject:
    """Part of a scene that is worth looking at.

    Attributes:
        points: (N, 3) surfel centres, world.
        centre: (3,) of their sphere, world.
        radius: of that sphere, world units.
    """

    points: np.ndarray
    centre: np.ndarray
    radius: float


def find_subject(scene: Surfels) -> Subject:
    """The surfels that matter, strays apart: those off the floor if the scene has a floor, else all."""
    shown = scene.means[_off_floor(scene)].astype(np.float64)
    low, high = np.quantile(shown, [STRAYS, 1 - STRAYS], axis=0)
    centre = (low + high) / 2
    from_centre = np.linalg.norm(shown - centre, axis=1)
    radius = float(np.quantile(from_centre, 1 - STRAYS))
    near = from_centre <= _REACH * radius
    held = shown[near][_joined(shown[near], from_centre[near] <= radius, max(radius, scene.spacing) / _CELLS)]
    low, high = held.min(0), held.max(0)
    centre = (low + high) / 2
    radius = float(np.linalg.norm(held - centre, axis=1).max())
    return Subject(held, centre, max(radius, scene.spacing))


def _joined(points: np.ndarray, core: np.ndarray, cell: float) -> np.ndarray:
    """(N,) bool: points of the ``core`` (N,), and those that hang together with most of it, in cells.

    A leaf or a hand that stands out holds fewer surfels than strays may, but no gap parts it from the rest.
    """
    if not cell > 0:
        return core
    place = ((points - points.min(0)) / cell).astype(int)
    held = np.zeros(place.max(0) + 1, int)
    np.add.at(held, tuple(place.T), 1)
    parts = np.empty(held.shape, int)
    from scipy.ndimage import label

    label(held >= _CROWD, np.ones((3, 3, 3)), output=parts)
    part = parts[tuple(place.T)]
    return core | ((part > 0) & (part == np.bincount(part[core]).argmax()))


def foot_height(heights: np.ndarray, opacity_logits: np.ndarray) -> float:
    """Height that a thing stands at: that of its lowest opaque surfels, strays apart.

    Args:
        heights: (M,) of the surfels' centres along up, world units.
        opacity_logits: (M,) of the surfels; where none is opaque, all count.
    """
    solid = opacity_logits > _OPAQUE_LOGIT
    return float(np.quantile(heights[solid if solid.any() else slice(None)], LOWEST))


def has_floor(scene: Surfels) -> bool:
    """Whether part of the scene is a floor that the rest stands on."""
    return not _off_floor(scene).all()


def _off_floor(scene: Surfels) -> np.ndarray:
    """(M,) bool: surfels that stand on or above the floor; all of them where no floor is found."""
    everything = np.ones(len(scene), dtype=bool)
    height = scene.means @ scene.up
    level = np.abs(scene.normals() @ scene.up) > _LEVEL_COSINE
    if level.sum() < _FLOOR_SHARE * len(scene):
        return everything
    # The floor is the fullest of thin slabs of level surfels; slabs overlap by half so that none is cut in
    # two.
    slab = _FLOOR_SPACINGS * scene.spacing
    heights = np.sort(height[level])
    held = np.searchsorted(heights, heights + slab, side="right") - np.arange(len(heights))
    floor = heights[held.argmax()]
    above = height > floor + slab
    if held.max() < _FLOOR_SHARE * len(scene) or above.sum() < _SUBJECT_SHARE * len(scene):
        return everything
    return above


def framed(
    subject: Subject,
    at: Callable[[float], list[V]],
    *,
    width: int,
    height: int,
    fov_deg: float,
    distance: float,
) -> list[V]:
    """Cameras of a path from as near as all of them hold the subject.

    Args:
        subject: what they look at.
        at: the path at a distance from the subject's centre, world units.
        width, height: pixels.
        fov_deg: horizontal field of view, degrees.
        distance: factor on the distance that is found.
    """
    probes = subject.points[:: max(1, len(subject.points) // _PROBES)]
    # From the far end a sphere around the subject fits into any frame; bisection of the logarithm from there.
    half = math.atan(math.tan(math.radians(fov_deg) / 2) * min(1.0, height / width) * (1 - 2 * BORDER))
    near, far = _NEAREST * subject.radius, max(_NEAREST, 1.1 / math.sin(half)) * subject.radius
    for _ in range(12):
        middle = math.sqrt(near * far)
        near, far = (near, middle) if _hold(at(middle), probes) else (middle, far)
    return at(distance * far)


def _hold(cameras: Sequence[Viewer], points: np.ndarray) -> bool:
    """Whether the images hold all but the strays of the points (N, 3), world, with a border to spare."""
    for camera in cameras[:: max(1, len(cameras) // _PROBE_CAMERAS)]:
        pixels, depth = camera.project(points)
        place = pixels / (camera.width, camera.height)
        inside = (depth > 0) & (np.abs(place - 0.5) < 0.5 - BORDER).all(axis=1)
        if inside.mean() < 1 - STRAYS:
            return False
    return True


def outward(azimuth_deg: np.ndarray, elevation_deg: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(N, 3) unit directions from a target to where cameras stand.

    Azimuth (N,) turns counter-clockwise about ``up`` seen from its tip, from the world's x axis where that is
    level; elevation (N,) is the angle above the level plane.

    Raises:
        TronError: up is zero.
    """
    east, north, zenith = _frame(np.asarray(up, dtype=np.float64))
    azimuth, elevation = np.radians(azimuth_deg)[:, None], np.radians(elevation_deg)[:, None]
    level = np.cos(azimuth) * east + np.sin(azimuth) * north
    return np.cos(elevation) * level + np.sin(elevation) * zenith


def _frame(up: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right-handed east, north, zenith; east is the world's x axis made orthogonal to up if it can be."""
    if not np.linalg.norm(up) > 0:
        raise TronError("up direction must not be zero")
    zenith = up / np.linalg.norm(up)
    axis = np.array([1.0, 0.0, 0.0]) if abs(zenith[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    east = axis - zenith * (axis @ zenith)
    east /= np.linalg.norm(east)
    return east, np.cross(zenith, east), zenith


def upright(up: np.ndarray) -> np.ndarray:
    """(3, 3) rotation, the shortest, that takes the unit direction `up` to +z, up in environment maps."""
    x, y, z = up
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    # Rodrigues' formula about up x z, with cos = z: R = I + [v]x + [v]x^2 / (1 + cos).
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + z)


def even_directions(count: int) -> np.ndarray:
    """(count, 3) unit vectors on Fibonacci's spiral (Gonzalez 2010, Measurement of areas on a sphere)."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
