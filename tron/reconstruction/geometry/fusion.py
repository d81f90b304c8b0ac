"""Depth maps of many views fused into one field of signed distances.

From "A Volumetric Method for Building Complex Models from Range Images" (Curless and Levoy 1996): each view
says how far a voxel lies before (positive) or behind (negative) the surface that it sees, cut off at some
voxels; the mean over the views crosses zero on the surface. Voxels that a mask shows to be empty are free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from tron.cameras import Camera
from tron.reconstruction.geometry.matching import project
from tron.reconstruction.settings import FusionSettings

_CHUNK = 1 << 19
_NEAREST = 1e-3
_PADDING = 0.05
_OUTLIERS = 0.01
_BLOCK = 4
_SAMPLED = 1 << 20
_STEPS = 4
_STRIDE = 0.8
_CLOSE = 0.25  # of the reach: farther from zero no surface was met
_STEEP = 0.15  # of a full slope: flatter fields have no direction
_SEEN = 0.5


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Distances that one view knows.

    Attributes:
        camera: the view.
        depth: (H, W) distance along the ray, world units; 0 where there is none.
        weight: (H, W) what each pixel counts in the fusion, 0 and up.
        empty: (H, W) bool, rays that meet nothing, or None where that is not known (see :func:`empty_rays`).
    """

    camera: Camera
    depth: Tensor
    weight: Tensor
    empty: Tensor | None = None

    @property
    def rays(self) -> Tensor:
        """(H, W, 3) unit directions through the pixel centres, world."""
        return torch.from_numpy(self.camera.rays()).to(self.depth.device)

    def points(self) -> Tensor:
        """(N, 3) of the pixels that count, world."""
        counts = (self.depth > 0) & (self.weight > 0)
        origin = self.depth.new_tensor(self.camera.position)
        return origin + self.depth[counts][:, None] * self.rays[counts]


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Truncated signed distances on a grid.

    Attributes:
        low: (3,) world, of the first voxel's centre.
        voxel: edge of a voxel, world units.
        reach: distance at which values are cut off, world units.
        value: (X, Y, Z) in [-1, 1], distance over reach; 1 where nothing was seen.
        weight: (X, Y, Z) sum of what was seen.
    """

    low: Tensor
    voxel: float
    reach: float
    value: Tensor
    weight: Tensor

    def smoothed(self, sigma: float) -> DistanceField:
        """Mean under a Gaussian of ``sigma`` voxels, weighted by what was seen."""
        if sigma <= 0:
            return self
        weight = _blurred(self.weight, sigma)
        value = _blurred(self.value * self.weight, sigma)
        known = weight > 1e-4
        value = torch.where(known, value / torch.where(known, weight, 1.0), 1.0)
        return DistanceField(self.low, self.voxel, self.reach, value, weight)

    def gradient(self) -> Tensor:
        """(3, X, Y, Z) central differences of the values, per world unit."""
        return torch.stack(torch.gradient(self.value, spacing=self.voxel))

    def sample(self, grids: Tensor, points: Tensor) -> Tensor:
        """Grids (C, X, Y, Z) at world points (N, 3), trilinear: (N, C); beyond the border the nearest."""
        size = points.new_tensor([side - 1 for side in grids.shape[1:]]).clamp(min=1)
        places = ((points - self.low) / self.voxel / size * 2 - 1).flip(-1)
        return F.grid_sample(
            grids[None], places[None, None, None], padding_mode="border", align_corners=True
        )[0, :, 0, 0].T


def pixel_footprint(maps: Sequence[DepthMap]) -> float:
    """Median width that a pixel covers on the surface, world units; 0 where no depth is known."""
    widths = [each.depth[each.weight > 0] / each.camera.fx for each in maps]
    every = torch.cat(widths)
    return float(every.median()) if len(every) else 0.0


def empty_rays(subject: Tensor) -> Tensor:
    """(H, W) bool, rays that meet nothing: pixels with no pixel of the ``subject``, (H, W) bool, beside them.

    A voxel is looked up in the nearest pixel, which beside a silhouette is one too far: without the margin
    masks carve half a voxel off a ball (measured: depth 0.025 wrong instead of 0.004, voxels of 0.036).
    """
    return F.max_pool2d(subject[None, None].float(), 3, 1, 1)[0, 0] == 0


def fuse(maps: Sequence[DepthMap], voxel: float, truncation: float, most_voxels: int) -> DistanceField | None:
    """The field of some depth maps, or None where they hold no surface.

    Args:
        maps: of all views.
        voxel: wanted edge of a voxel, world units; larger where the scene would need more than
            ``most_voxels`` along its longest side.
        truncation: voxels at which distances are cut off.
        most_voxels: see above.
    """
    every = max(sum(each.depth.numel() for each in maps) // _SAMPLED, 1)
    points = torch.cat([each.points()[::every] for each in maps])
    if len(points) < 4:
        return None
    ordered = points.sort(0).values
    cut = int(_OUTLIERS * (len(points) - 1))
    low, high = ordered[cut], ordered[len(points) - 1 - cut]
    longest = float((high - low).max())
    if not longest > 0:
        return None
    low, high = low - _PADDING * longest, high + _PADDING * longest
    voxel = max(voxel, (1 + 2 * _PADDING) * longest / most_voxels)
    shape = tuple(int(side) + 1 for side in torch.ceil((high - low) / voxel).tolist())
    reach = truncation * voxel
    value, weight = (torch.zeros(shape, device=low.device).reshape(-1) for _ in range(2))
    near = _near(points, low, voxel, shape, truncation)
    for some in near.split(_CHUNK):
        places = torch.stack(torch.unravel_index(some, shape), -1)
        distance, seen = _distances(maps, low + places * voxel, reach)
        weight[some] = seen
        value[some] = distance
    value = torch.where(weight > 0, value / weight.clamp(min=1e-9), 1.0)
    return DistanceField(low, voxel, reach, value.reshape(shape), weight.reshape(shape))


def _near(points: Tensor, low: Tensor, voxel: float, shape: Sequence[int], truncation: float) -> Tensor:
    """Flat indices of the voxels around the points, with room for the truncation and what blurs it."""
    blocks = [-(-side // _BLOCK) for side in shape]
    place = ((points - low) / (voxel * _BLOCK)).long()
    limits = torch.tensor(blocks, device=points.device)
    place = place[((place >= 0) & (place < limits)).all(-1)]
    marked = torch.zeros(blocks, device=points.device)
    marked[place[:, 0], place[:, 1], place[:, 2]] = 1
    reach = 2 * int(-(-truncation // _BLOCK)) + 1
    marked = F.max_pool3d(marked[None, None], reach, 1, reach // 2)[0, 0] > 0
    for axis in range(3):
        marked = marked.repeat_interleave(_BLOCK, axis)
    marked = marked[: shape[0], : shape[1], : shape[2]]
    return torch.nonzero(marked.reshape(-1))[:, 0]


def _distances(maps: Sequence[DepthMap], points: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """Sums over the views of weight x distance / reach and of weight, (N,) each, at world points (N, 3)."""
    total, weight = points.new_zeros(len(points)), points.new_zeros(len(points))
    for each in maps:
        camera = each.camera
        pixels, z = project(camera, points)
        column, row = pixels.long().unbind(-1)
        inside = (z > _NEAREST) & (pixels >= 0).all(-1) & (column < camera.width) & (row < camera.height)
        index = torch.where(inside, row * camera.width + column, 0)
        depth = each.depth.reshape(-1)[index]
        distance = depth - (points - points.new_tensor(camera.position)).norm(dim=-1)
        counts = inside & (depth > 0) & (distance > -reach)
        counts = counts * each.weight.reshape(-1)[index]
        total += counts * (distance / reach).clamp(-1, 1)
        weight += counts
        if each.empty is not None:
            empty = (inside & each.empty.reshape(-1)[index]).float()
            total += empty
            weight += empty
    return total, weight


def _blurred(grid: Tensor, sigma: float) -> Tensor:
    """(X, Y, Z) under a Gaussian of four sigma's reach, zero beyond the border."""
    reach = max(round(4 * sigma), 1)
    offsets = torch.arange(-reach, reach + 1, device=grid.device)
    kernel = torch.exp(-0.5 * (offsets / sigma) ** 2)
    kernel = kernel / kernel.sum()
    for axis in range(3):
        shape, padding = [1, 1, 1, 1, 1], [0, 0, 0]
        shape[2 + axis], padding[axis] = len(kernel), reach
        grid = F.conv3d(grid[None, None], kernel.reshape(shape), padding=padding)[0, 0]
    return grid


def fused_views(maps: Sequence[DepthMap], settings: FusionSettings) -> list[tuple[Tensor, Tensor]]:
    """The views' consensus on their own fused depths, as of :func:`consensus`; empty without a surface."""
    field = fuse(maps, pixel_footprint(maps), settings.truncation, settings.most_voxels)
    return [] if field is None else consensus(field, maps, settings.sigma)


def consensus(field: DistanceField, maps: Sequence[DepthMap], sigma: float) -> list[tuple[Tensor, Tensor]]:
    """Depth (H, W) and unit normal (H, W, 3), world, of each view; 0 where the views do not agree.

    Args:
        field: of the same maps.
        maps: a walk begins at a view's own depth.
        sigma: of the Gaussian that smooths the field, voxels.
    """
    smooth = field.smoothed(sigma)
    grids = torch.cat([smooth.value[None], smooth.gradient(), smooth.weight[None]])
    return [_walked(smooth, grids, each) for each in maps]


def _walked(field: DistanceField, grids: Tensor, view: DepthMap) -> tuple[Tensor, Tensor]:
    starts = view.depth > 0
    origin = view.depth.new_tensor(view.camera.position)
    every = view.rays
    rays, depth = every[starts], view.depth[starts]
    for _ in range(_STEPS):
        value = field.sample(grids[:1], origin + depth[:, None] * rays)[:, 0]
        depth = depth + _STRIDE * field.reach * value
    found = field.sample(grids, origin + depth[:, None] * rays)
    normal = found[:, 1:4]
    slope = normal.norm(dim=-1)
    normal = normal / slope.clamp(min=1e-9)[:, None]
    agreed = (found[:, 0].abs() < _CLOSE) & (slope * field.reach > _STEEP) & (found[:, 4] > _SEEN)
    agreed &= (normal * rays).sum(-1) < 0
    depths = torch.zeros_like(view.depth)
    normals = torch.zeros_like(every)
    depths[starts] = depth * agreed
    normals[starts] = normal * agreed[:, None]
    return depths, normals
