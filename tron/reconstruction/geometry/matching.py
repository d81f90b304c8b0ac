"""Matching cost of two photographs for hypothetical distances along a pixel's ray.

A pixel of one photograph and a distance along its ray make a point; the other photograph shows that point
somewhere. Windows around the two places are compared by half 1 - ZNCC of their greys, which is blind to
exposure, and half the difference of their colours, which tells plain surfaces apart. The window is warped
pixel by pixel with the distances of its own pixels: distances that slant make slanted patches, as in
PatchMatch stereo (Bleyer et al. 2011) and in PGSR (Chen et al. 2024), which warp by planes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tron.cameras import Camera
from tron.captures import View

COLOUR_LIMIT = 0.08
"""Difference of display colours, mean over the channels, from which on two windows are just different."""
_SUBJECT = 0.5
_FLAT = 1e-4  # variance of a window in which 8 bits hold nothing but noise
_NEAREST = 1e-3
_ROUNDING = 1 / 255
_CHUNK = 1 << 20  # hypotheses compared at once: some 60 bytes each


@dataclass(frozen=True, eq=False)
class Photograph:
    """A view as the matching reads it, on torch's device.

    Attributes:
        camera: the view's, of the picture's size.
        image: (3, H, W) float32 display values.
        subject: (H, W) bool, true everywhere where there is no mask.
    """

    camera: Camera
    image: Tensor
    subject: Tensor

    @staticmethod
    def of(view: View, most_side: int, device: str | torch.device) -> Photograph:
        """A view, reduced by area until its longer side has at most ``most_side`` pixels."""
        view = view.reduced(max(max(view.camera.width, view.camera.height) / most_side, 1))
        image = torch.from_numpy(view.read("image")).movedim(-1, 0)
        subject = view.believed()
        if view.has("mask"):
            subject &= view.read("mask") > _SUBJECT
        return Photograph(view.camera, image.to(device), torch.from_numpy(subject).to(device))

    @property
    def rays(self) -> Tensor:
        """(H, W, 3) unit directions through the pixel centres, world."""
        return torch.from_numpy(self.camera.rays()).to(self.image.device)

    @property
    def along(self) -> Tensor:
        """(H, W) cosine between each ray and the optical axis: z over distance."""
        return self.rays @ self.rays.new_tensor(self.camera.forward)

    @property
    def grey(self) -> Tensor:
        """(H, W) mean of the channels."""
        return self.image.mean(0)

    def textured(self, radius: int) -> Tensor:
        """(H, W) bool, windows that differ from one grey by more than 8 bits' rounding."""
        grey = self.grey
        mean, square = window_mean(torch.stack([grey, grey**2]), radius)
        return square - mean * mean > _ROUNDING**2


def window_mean(maps: Tensor, radius: int) -> Tensor:
    """Mean over the windows of 2 ``radius`` + 1 pixels a side, cut off at the border; (..., H, W).

    Sums of shifted copies, first along the rows, then along the columns: a fifth of the time of torch's
    pooling on a processor.
    """
    for axis in (-1, -2):
        size = maps.shape[axis]
        total, count = maps.clone(), maps.new_ones(size)
        for shift in range(1, min(radius, size - 1) + 1):
            kept = size - shift
            total.narrow(axis, 0, kept).add_(maps.narrow(axis, shift, kept))
            total.narrow(axis, shift, kept).add_(maps.narrow(axis, 0, kept))
            count[:kept] += 1
            count[shift:] += 1
        maps = total.div_(count if axis == -1 else count[:, None])
    return maps


def project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (..., 2), x then y, and z (...) of world points (..., 3); pixels mean nothing where z <= 0."""
    rotation = points.new_tensor(camera.world_to_camera[:3, :3])
    local = points @ rotation.T + points.new_tensor(camera.world_to_camera[:3, 3])
    z = local[..., 2]
    focal = points.new_tensor([camera.fx, camera.fy])
    pixels = local[..., :2] / z.clamp(min=_NEAREST)[..., None] * focal
    return pixels + points.new_tensor([camera.cx, camera.cy]), z


def sample(maps: Tensor, pixels: Tensor, mode: str = "bilinear") -> Tensor:
    """Maps (C, H, W) at pixels (K, H', W', 2), 0 beside the picture: (K, C, H', W')."""
    size = pixels.new_tensor([maps.shape[2], maps.shape[1]])
    source = maps[None].expand(len(pixels), -1, -1, -1)
    return F.grid_sample(source, pixels / size * 2 - 1, mode, align_corners=False)


def matching_cost(reference: Photograph, other: Photograph, distances: Tensor, radius: int) -> Tensor:
    """Cost in [0, 1] of hypotheses for each pixel of ``reference``; 1 where ``other`` does not show it.

    Args:
        reference: the photograph whose distances are sought.
        other: the photograph to compare with.
        distances: (K, H, W) along the unit rays, world units.
        radius: of the windows, pixels.

    Returns:
        (K, H, W) float32.
    """
    height, width = distances.shape[1:]
    at_once = max(_CHUNK // (height * width), 1)
    grey = reference.grey
    mean, square = window_mean(torch.stack([grey, grey * grey]), radius)
    variance = (square - mean * mean).clamp(min=0)
    shown = torch.cat([other.image, other.subject[None].float()])
    position, rays = grey.new_tensor(reference.camera.position), reference.rays
    costs = []
    for some in distances.split(at_once):
        pixels, z = project(other.camera, position + some[..., None] * rays)
        warped = sample(shown, pixels)
        g = warped[:, :3].mean(1)
        apart = (warped[:, :3] - reference.image).abs().mean(1)
        m, mm, mg, apart = window_mean(torch.stack([g, g * g, g * grey, apart]), radius)
        v = (mm - m * m).clamp(min=0)
        zncc = (mg - m * mean + _FLAT) / ((v + _FLAT) * (variance + _FLAT)).sqrt()
        cost = 0.5 * (1 - zncc).clamp(0, 1) + 0.5 * (apart / COLOUR_LIMIT).clamp(max=1)
        costs.append(torch.where((z > _NEAREST) & (warped[:, 3] > _SUBJECT), cost, 1.0))
    return torch.cat(costs)


def agreed_cost(
    reference: Photograph, others: list[Photograph], distances: Tensor, radius: int, best: int
) -> Tensor:
    """Mean cost over the ``best`` other photographs, (K, H, W), so that occluded ones drop out."""
    costs = torch.stack([matching_cost(reference, other, distances, radius) for other in others])
    return costs.topk(min(best, len(others)), 0, largest=False, sorted=False).values.mean(0)


def refined_minimum(cost: Tensor) -> tuple[Tensor, Tensor]:
    """Place of the smallest of K costs (K, H, W), a fraction of a step exact, and the cost there.

    The vertex of the parabola through the minimum and its two neighbours.
    """
    place = cost.argmin(0).clamp(1, len(cost) - 2)
    before, at, after = (cost.gather(0, (place + step)[None])[0] for step in (-1, 0, 1))
    offset = 0.5 * (before - after) / (before - 2 * at + after).clamp(min=1e-5)
    return place + offset.clamp(-0.5, 0.5), cost.amin(0)


def angles_between(directions: np.ndarray) -> np.ndarray:
    """(N, N) angles between unit directions (N, 3), degrees."""
    return np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))
