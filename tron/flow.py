"""Exact optical flow between two views of known depth, and which pixels both of them see.

A surface point at distance d along a pixel's ray is X = o + d r. Where it stands in another camera is that
camera's projection of X, or of M X where the surface moved by a rigid M in between; the flow is that place
minus the pixel's centre. What lies behind everything is infinitely far and has no parallax: it is the
projection of r alone. Unlike an estimated flow this has no error but rounding, so that a warping error by it
(Lai et al. 2018, "Learning Blind Video Temporal Consistency", eq. 10) is the pictures' own.

NumPy only. Images are (H, W, ...), indexed by row, then column; cameras are OpenCV's (:mod:`tron.cameras`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from tron.cameras import Camera
from tron.errors import TronError

TOLERANCE = 0.01
"""Relative difference of inverse depths up to which two views see one point."""

EDGE = 0.1
"""The same for each of the four pixels around a place: beyond it they lie on another surface."""

REMEMBERED = 32
"""Depths that a clip's motion keeps: windows that overlap ask for the same."""


class Match(NamedTuple):
    """Places of one view's surfaces in another.

    Attributes:
        displacement: (H, W, 2) pixels, x then y, as :func:`flow` gives it.
        seen: (H, W) bool, whether the surface is seen there, as :func:`both_see` tells.
    """

    displacement: np.ndarray
    seen: np.ndarray


def flow(
    depth: np.ndarray,
    camera: Camera,
    other: Camera,
    moving: np.ndarray | None = None,
    motion: np.ndarray | None = None,
) -> np.ndarray:
    """Displacement of each pixel of ``camera`` to where ``other`` sees its surface.

    Args:
        depth: (H, W) or (H, W, 1) distance from ``camera`` along the rays, world units; 0 where there is no
            surface, as in the member ``depth_ref``.
        camera: the view whose pixels are asked for.
        other: the view that they are looked for in, at its own time.
        moving: (H, W) bool, pixels whose surface moves; None: none does.
        motion: (4, 4) rigid motion of those surfaces, from the world at ``camera``'s time to the world at
            ``other``'s.

    Returns:
        (H, W, 2) float64 pixels, x then y; NaN where the point is not in front of ``other``.

    Raises:
        TronError: depth or ``moving`` is not of the camera's size, or one of ``moving`` and ``motion`` is
            given without the other.
    """
    place, in_front, _ = _seen_from(depth, camera, other, moving, motion)
    return _displacement(place, in_front, camera)


def both_see(
    depth: np.ndarray,
    camera: Camera,
    other_depth: np.ndarray,
    other: Camera,
    moving: np.ndarray | None = None,
    motion: np.ndarray | None = None,
) -> np.ndarray:
    """(H, W) bool: pixels of ``camera`` whose surface ``other`` sees too, in all four pixels around it.

    1/z is affine on a plane, so it is interpolated without error on one; where it differs by more than
    :data:`TOLERANCE`, something else is seen there. Nor may any of the four pixels be far off
    (:data:`EDGE`): a mean over an edge is of no surface. Pixels without a surface are seen where the four
    have none either. The border of half a pixel, which cannot be interpolated, is not seen.

    Args:
        depth, camera, other, moving, motion: as of :func:`flow`.
        other_depth: (H', W') or (H', W', 1) distance from ``other`` along its rays, 0 where there is none.

    Raises:
        TronError: sizes differ from the cameras'.
    """
    return match(depth, camera, other_depth, other, moving, motion).seen


def match(
    depth: np.ndarray,
    camera: Camera,
    other_depth: np.ndarray,
    other: Camera,
    moving: np.ndarray | None = None,
    motion: np.ndarray | None = None,
) -> Match:
    """:func:`flow` and :func:`both_see` at once, of the same arguments."""
    place, in_front, expected = _seen_from(depth, camera, other, moving, motion)
    taps, weights, inside = _taps(place, other.width, other.height)
    inverse = _inverse_z(_plane(other_depth, other, "the other depth"), other)
    around = inverse.reshape(-1)[taps]
    found = (around * weights).sum(-1)
    near = np.abs(around - expected[..., None]) <= EDGE * expected[..., None]
    agrees = np.abs(found - expected) <= TOLERANCE * expected
    return Match(_displacement(place, in_front, camera), in_front & inside & near.all(-1) & agrees)


def surface_motion(
    cameras: Sequence[Camera],
    depth: Callable[[int], np.ndarray],
    moves: Callable[[int, int], tuple[np.ndarray, np.ndarray]] | None = None,
    still_sky: bool = True,
) -> Callable[[int, int], Match]:
    """Match of each frame of a clip in each other frame, by their numbers.

    Args:
        cameras: one a frame.
        depth: reads a frame's (H, W) or (H, W, 1) distance along the rays, world units, 0 where there is no
            surface; asked once where frames near each other are asked for.
        moves: frame and other frame -> pixels and motion, as :func:`flow` has them; None: nothing moves.
        still_sky: whether what is infinitely far stands still; if not, it is never seen again.

    Returns:
        What gives the matches; it raises TronError for a depth of another size than its camera's.
    """
    read = lru_cache(REMEMBERED)(depth)

    def between(index: int, other: int) -> Match:
        motion = () if moves is None else moves(index, other)
        found = match(read(index), cameras[index], read(other), cameras[other], *motion)
        if not still_sky:
            found.seen[_plane(read(index), cameras[index], "depth") <= 0] = False
        return found

    return between


def warp(image: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Image of the other view as seen from the pixels of a flow, interpolated bilinearly.

    Args:
        image: (H', W', C) of the other view.
        displacement: (H, W, 2) of :func:`flow`.

    Returns:
        (H, W, C) float64; NaN beyond the centres of its outermost pixels.

    Raises:
        TronError: the image has less than 2 x 2 pixels.
    """
    height, width = displacement.shape[:2]
    place = displacement + _grid(width, height)
    taps, weights, inside = _taps(place, image.shape[1], image.shape[0])
    pixels = np.asarray(image, np.float64).reshape(image.shape[0] * image.shape[1], -1)
    found = (pixels[taps] * weights[..., None]).sum(-2)
    return np.where(inside[..., None], found, np.nan)


def _seen_from(
    depth: np.ndarray,
    camera: Camera,
    other: Camera,
    moving: np.ndarray | None,
    motion: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places in ``other`` (H, W, 2), whether they are in front of it (H, W), and 1 / z there (H, W)."""
    distance = _plane(depth, camera, "depth")
    if (moving is None) != (motion is None):
        raise TronError("flow of a moving surface needs both its pixels and its motion")
    surface = distance > 0
    rays = camera.exact_rays()
    points = camera.position + rays * distance[..., None]
    if moving is not None and motion is not None:
        which = _plane(moving, camera, "the moving pixels") > 0
        matrix = np.asarray(motion, np.float64)
        points = np.where(which[..., None], points @ matrix[:3, :3].T + matrix[:3, 3], points)
    # What is infinitely far is seen in its direction from wherever the other camera stands.
    points = np.where(surface[..., None], points, other.position + rays)
    pixels, z = other.project(points.reshape(-1, 3))
    place, z = pixels.reshape(*surface.shape, 2), z.reshape(surface.shape)
    in_front = z > 0
    return place, in_front, np.divide(1.0, z, out=np.zeros_like(z), where=in_front & surface)


def _displacement(place: np.ndarray, in_front: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W, 2) from the centres of pixels to places; NaN where they are not in front."""
    return np.where(in_front[..., None], place - _centres(camera), np.nan)


def _plane(image: np.ndarray, camera: Camera, what: str) -> np.ndarray:
    """(H, W) float64 of an image with or without an axis for its one channel."""
    values = np.asarray(image, np.float64)
    values = values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
    if values.shape != (camera.height, camera.width):
        raise TronError(
            f"{what} is of shape {np.shape(image)}, its camera has {camera.width} x {camera.height} pixels"
        )
    return values


def _inverse_z(distance: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) 1 / z from distances along the rays; 0 where there is no surface."""
    z = distance * (camera.exact_rays() @ camera.forward)
    return np.divide(1.0, z, out=np.zeros_like(z), where=z > 0)


def _centres(camera: Camera) -> np.ndarray:
    return _grid(camera.width, camera.height)


def _grid(width: int, height: int) -> np.ndarray:
    """(H, W, 2) centres of pixels, x then y."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)


def _taps(place: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flat numbers and weights (H, W, 4) of the pixels around places, and whether there are four."""
    if width < 2 or height < 2:
        raise TronError(f"a picture of {width} x {height} pixels cannot be interpolated: 2 x 2 are the least")
    # Round-off must not put a pixel that stays where it is outside.
    at = np.nan_to_num(place, nan=-1.0, posinf=-1.0, neginf=-1.0) - 0.5
    at = np.where(np.abs(at - np.round(at)) < 1e-9, np.round(at), at)
    inside = (at >= 0).all(-1) & (at[..., 0] <= width - 1) & (at[..., 1] <= height - 1)
    first = np.clip(np.floor(at), 0, (width - 2, height - 2)).astype(np.int64)
    right, down = np.clip(np.moveaxis(at - first, -1, 0), 0.0, 1.0)
    corner = first[..., 1] * width + first[..., 0]
    taps = corner[..., None] + np.array([0, 1, width, width + 1])
    weights = np.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down], -1)
    return taps, weights, inside
