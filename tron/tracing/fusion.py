"""Fusion of many views' depth maps into one truncated signed distance field, and the surface they agree on.

From "A Volumetric Method for Building Complex Models from Range Images" (Curless and Levoy 1996): each view
gives a voxel's distance before (positive) or behind (negative) the surface that it sees, truncated at a few
voxels; the mean over the views crosses zero on the surface. Voxels outside a view's mask are empty.
One kernel runs over all voxels, and within each over the views: 64 views of 200 x 200 take 0.3 s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter, grey_opening, maximum_filter

from tron.cameras import Camera
from tron.runtime import aligned, lanes

_NEAREST = 1e-3
_PADDING = 0.05
_OUTLIERS = 0.01
_BLOCK = 4
_SAMPLED = 1 << 20
_STEPS = 4
_STRIDE = 0.8
_CLOSE = 0.25  # of the reach: values farther from zero are no surface
_STEEP = 0.15  # of a full slope: flatter fields have no normal
_SEEN = 0.5
_CAMERA, _SIZE = 19, 3


@dataclass(frozen=True, eq=False)
class DepthMap:
    """The depth map of one view.

    Attributes:
        camera: the view.
        depth: (H, W) distance along the ray, world units; 0 where there is none.
        weight: (H, W) weight of each pixel in the fusion, 0 or more.
        empty: (H, W) bool, rays that meet nothing (see :func:`empty_rays`), or None if that is not known.
    """

    camera: Camera
    depth: np.ndarray
    weight: np.ndarray
    empty: np.ndarray | None = None

    def points(self) -> np.ndarray:
        """(N, 3) float64 surface points of the pixels with weight, world."""
        counts = (self.depth > 0) & (self.weight > 0)
        return self.camera.position + self.depth[counts][:, None] * self.camera.rays()[counts]


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Truncated signed distances on a grid.

    Attributes:
        low: (3,) world, centre of the first voxel.
        voxel: edge of a voxel, world units.
        reach: distance at which values are truncated, world units.
        value: (X, Y, Z) float32 in [-1, 1], distance over reach; 1 in unseen voxels.
        weight: (X, Y, Z) float32, sum of the views' weights.
    """

    low: np.ndarray
    voxel: float
    reach: float
    value: np.ndarray
    weight: np.ndarray

    def smoothed(self, sigma: float) -> DistanceField:
        """Smooth by a Gaussian of ``sigma`` voxels, truncated at four sigma, weighted by ``weight``."""
        if sigma <= 0:
            return self
        weight, value = (
            gaussian_filter(grid, sigma, mode="constant") for grid in (self.weight, self.value * self.weight)
        )
        known = weight > 1e-4
        value = np.where(known, value / np.where(known, weight, 1), 1).astype(np.float32)
        return DistanceField(self.low, self.voxel, self.reach, value, weight)

    def closed(self, radius: int) -> DistanceField:
        """Fill pits, cracks and holes of up to ``radius`` voxels to either side.

        Morphological closing of the solid by a cube (Serra 1982), which keeps convex edges.
        """
        value = grey_opening(self.value, 2 * radius + 1, mode="nearest")  # solid is negative
        return replace(self, value=np.where(self.weight > 0, value, self.value))

    def sampler(self) -> Sampler:
        """Upload the field to the device."""
        grids = mi.TensorXf(aligned(np.stack([self.value, self.weight], -1).astype(np.float32)))
        texture = mi.Texture3f(grids, use_accel=False, wrap_mode=dr.WrapMode.Clamp)
        low, size = _opaque(self.low), _opaque(np.array(self.value.shape))
        return Sampler(texture, low, size, dr.opaque(mi.Float, self.voxel), dr.opaque(mi.Float, self.reach))


@dataclass(frozen=True, eq=False)
class Sampler:
    """Trilinear lookup in a field; beyond the border, the nearest voxel's values (Dr.Jit)."""

    texture: Any
    low: mi.Point3f
    size: mi.Point3f
    voxel: mi.Float
    reach: mi.Float

    def at(self, point: mi.Point3f) -> tuple[mi.Float, mi.Float]:
        """Value and weight at world points."""
        place = ((point - self.low) / self.voxel + 0.5) / self.size
        value, weight = self.texture.eval(mi.Point3f(place.z, place.y, place.x))
        return value, weight

    def gradient(self, point: mi.Point3f) -> mi.Vector3f:
        """Gradient by central differences, one voxel to either side, per world unit."""
        parts = []
        for axis in range(3):
            step = mi.Vector3f(0)
            step[axis] = self.voxel
            parts.append((self.at(point + step)[0] - self.at(point - step)[0]) / (2 * self.voxel))
        return mi.Vector3f(*parts)


def _opaque(three: np.ndarray) -> mi.Point3f:
    """Make a number a variable: each value of a literal would compile its own kernel."""
    point = mi.Point3f(*(float(value) for value in three))
    dr.make_opaque(point)
    return point


def pixel_footprint(maps: Sequence[DepthMap]) -> float:
    """Median width of a pixel on the surface, world units; 0 if no depth is known."""
    widths = np.concatenate([each.depth[each.weight > 0] / each.camera.fx for each in maps])
    return float(np.median(widths)) if len(widths) else 0.0


def empty_rays(subject: np.ndarray) -> np.ndarray:
    """(H, W) bool, rays that meet nothing: pixels without a pixel of ``subject``, (H, W) bool, next to them.

    A voxel is looked up in the nearest pixel, which may lie just outside a silhouette: without this margin,
    masks carve half a voxel off a ball (depth error 0.025 instead of 0.004, voxels of 0.036).
    """
    return ~maximum_filter(subject, 3, mode="constant")


def fuse(maps: Sequence[DepthMap], voxel: float, truncation: float, most_voxels: int) -> DistanceField | None:
    """Fuse depth maps into a field; None if they hold no surface.

    Args:
        maps: of all views.
        voxel: wanted edge of a voxel, world units; enlarged if the scene would need more than
            ``most_voxels`` along its longest side.
        truncation: distance at which values are truncated, voxels.
        most_voxels: see above.
    """
    every = max(sum(each.depth.size for each in maps) // _SAMPLED, 1)
    points = np.concatenate([each.points()[::every] for each in maps])
    if len(points) < 4:
        return None
    ordered = np.sort(points, 0)
    cut = int(_OUTLIERS * (len(points) - 1))
    low, high = ordered[cut], ordered[len(points) - 1 - cut]
    longest = float((high - low).max())
    if not longest > 0:
        return None
    low, high = low - _PADDING * longest, high + _PADDING * longest
    voxel = max(voxel, (1 + 2 * _PADDING) * longest / most_voxels)
    shape = np.ceil((high - low) / voxel).astype(int) + 1
    near, reach = _near(points, low, voxel, shape, truncation), truncation * voxel
    cells = mi.Point3u(
        *(mi.UInt32(aligned(axis.astype(np.uint32))) for axis in np.unravel_index(near, shape))
    )
    total, seen = _distances(_opaque(low) + mi.Point3f(cells) * dr.opaque(mi.Float, voxel), maps, reach)
    value, weight = np.ones(shape.prod(), np.float32), np.zeros(shape.prod(), np.float32)
    weight[near] = seen
    value[near] = np.where(seen > 0, total / np.maximum(seen, 1e-9), 1)
    return DistanceField(low, voxel, reach, value.reshape(shape), weight.reshape(shape))


def _near(
    points: np.ndarray, low: np.ndarray, voxel: float, shape: np.ndarray, truncation: float
) -> np.ndarray:
    """Flat indices of the voxels around the points, within truncation and smoothing."""
    blocks = -(-shape // _BLOCK)
    place = ((points - low) / (voxel * _BLOCK)).astype(int)
    place = place[((place >= 0) & (place < blocks)).all(-1)]
    marked = np.zeros(blocks, bool)
    marked[tuple(place.T)] = True
    marked = maximum_filter(marked, 2 * int(-(-truncation // _BLOCK)) + 1, mode="constant")
    for axis in range(3):
        marked = marked.repeat(_BLOCK, axis)
    return np.flatnonzero(marked[: shape[0], : shape[1], : shape[2]])


def _distances(points: mi.Point3f, maps: Sequence[DepthMap], reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Sums over the views of weight x distance / reach and of weight, (N,) each, at world points."""
    first = np.cumsum([0, *(each.depth.size for each in maps)])
    sizes = [(each.camera.width, each.camera.height, start) for each, start in zip(maps, first)]
    cameras = [
        [*each.camera.world_to_camera[:3].ravel(), *_pinhole(each.camera), *each.camera.position]
        for each in maps
    ]
    empty = [np.zeros(each.depth.shape) if each.empty is None else each.empty for each in maps]
    depths, weights = [each.depth for each in maps], [each.weight for each in maps]
    found = _summed(
        points,
        mi.Float(aligned(np.ravel(cameras).astype(np.float32))),
        mi.UInt32(aligned(np.ravel(sizes).astype(np.uint32))),
        *(mi.Float(aligned(np.concatenate([np.ravel(a) for a in some]).astype(np.float32)))
          for some in (depths, weights, empty)),
        dr.opaque(mi.UInt32, len(maps)),
        dr.opaque(mi.Float, reach),
    )  # fmt: skip
    dr.eval(found)
    return np.array(found[0]), np.array(found[1])


def _pinhole(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx, camera.cy


@dr.syntax
def _summed(
    point: mi.Point3f, cameras: mi.Float, sizes: mi.UInt32, depth: mi.Float, weight: mi.Float,
    empty: mi.Float, views: mi.UInt32, reach: mi.Float,
) -> tuple[mi.Float, mi.Float]:  # fmt: skip
    total, seen, view = mi.Float(0), mi.Float(0), mi.UInt32(0)
    while view < views:
        camera = [dr.gather(mi.Float, cameras, view * _CAMERA + k) for k in range(_CAMERA)]
        width, height, first = (dr.gather(mi.UInt32, sizes, view * _SIZE + k) for k in range(_SIZE))
        x, y, z = (
            camera[k] * point.x + camera[k + 1] * point.y + camera[k + 2] * point.z + camera[k + 3]
            for k in (0, 4, 8)
        )
        u, v = camera[12] * x / z + camera[14], camera[13] * y / z + camera[15]
        inside = (z > _NEAREST) & (u >= 0) & (v >= 0) & (u < mi.Float(width)) & (v < mi.Float(height))
        column, row = (mi.UInt32(dr.select(inside, place, 0)) for place in (u, v))
        pixel = first + row * width + column
        known = dr.gather(mi.Float, depth, pixel, inside)
        distance = known - dr.norm(point - mi.Point3f(camera[16], camera[17], camera[18]))
        counts = inside & (known > 0) & (distance > -reach)
        share = dr.select(counts, dr.gather(mi.Float, weight, pixel, inside), 0)
        free = dr.gather(mi.Float, empty, pixel, inside)
        total += share * dr.clip(distance / reach, -1, 1) + free
        seen += share + free
        view += 1
    return total, seen


def fused_views(
    maps: Sequence[DepthMap], truncation: float, sigma: float, most_voxels: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Fuse the views and return their :func:`consensus`; empty without a surface."""
    field = fuse(maps, pixel_footprint(maps), truncation, most_voxels)
    return [] if field is None else consensus(field, maps, sigma)


def consensus(
    field: DistanceField, maps: Sequence[DepthMap], sigma: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Depth (H, W) and unit normal (H, W, 3), world, of each view, float32; 0 where views do not agree.

    Args:
        field: of the same maps.
        maps: the search along a ray begins at the view's own depth.
        sigma: of the Gaussian that smooths the field, voxels.
    """
    sampler = field.smoothed(sigma).sampler()
    return [_walked(sampler, each) for each in maps]


def _walked(field: Sampler, view: DepthMap) -> tuple[np.ndarray, np.ndarray]:
    starts = view.depth > 0
    rays = np.ascontiguousarray(view.camera.rays()[starts], np.float32)
    depths, normals = np.zeros(starts.shape, np.float32), np.zeros((*starts.shape, 3), np.float32)
    if not len(rays):
        return depths, normals
    ray = lanes(mi.Vector3f, rays)
    origin = _opaque(view.camera.position)
    depth = mi.Float(aligned(view.depth[starts].astype(np.float32)))
    for _ in range(_STEPS):
        depth += _STRIDE * field.reach * field.at(origin + depth * ray)[0]
    value, seen = field.at(origin + depth * ray)
    normal = field.gradient(origin + depth * ray)
    slope = dr.norm(normal)
    normal /= dr.maximum(slope, 1e-9)
    agreed = (dr.abs(value) < _CLOSE) & (slope * field.reach > _STEEP) & (seen > _SEEN)
    agreed &= dr.dot(normal, ray) < 0
    depth, normal = dr.select(agreed, depth, 0), dr.select(agreed, normal, 0)
    dr.eval(depth, normal)
    depths[starts], normals[starts] = np.array(depth), np.array(normal).T
    return depths, normals
