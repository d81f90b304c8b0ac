"""The first surfels of a capture whose views have depth maps: one every few pixels' worth of surface."""

from __future__ import annotations

import numpy as np

from tron.captures import Capture, View
from tron.color import srgb_to_linear
from tron.gaussians.initialize import GBufferView, surfels_from_gbuffers
from tron.gaussians.scene import GaussianScene
from tron.reconstruction.settings import InitialSettings
from tron.seeds import generator

# Fractions of the distance to neighbouring surfels, measured for each kernel (docs/conventions.md, 6).
_SCALES = {2: 0.6, 4: 0.4}
_SUBJECT = 0.5
# A few pixels a surfel say all that surfels of that size can hold.
_PIXELS_PER_SURFEL = 64


def surfels_from_depth(capture: Capture, settings: InitialSettings, seed: int) -> GaussianScene:
    """About ``settings.count`` opaque surfels through the depth maps of the training views.

    Normals are the views' own where they have them, else those of the depth maps. Base color is the views'
    own, else the picture's, decoded from sRGB.

    Raises:
        TronError: no depth map holds a surface.
    """
    views = [view for view in capture.train_views if view.has("depth")]
    per_view = max(settings.count * _PIXELS_PER_SURFEL // len(views), 64)
    samples = [_gbuffer(view, per_view, seed) for view in views]
    return surfels_from_gbuffers(
        samples,
        count=settings.count,
        kernel_degree=settings.kernel_degree,
        scale=_SCALES[settings.kernel_degree],
        up=capture.up.tolist(),
    )


def _gbuffer(view: View, most: int, seed: int) -> GBufferView:
    depth, image = view.read("depth"), view.read("image")
    position = view.camera.position + depth[..., None] * view.camera.rays()
    normal = view.read("normal") if view.has("normal") else normals_of_depth(view, depth)
    valid = (depth > 0) & ((normal * normal).sum(-1) > 0.25)
    if view.has("mask"):
        valid &= view.read("mask") > _SUBJECT
    valid &= view.believed()
    if valid.sum() > most:
        draw = generator(seed, "reconstruction", "depth", view.name)
        valid &= draw.random(valid.shape) < most / valid.sum()
    return GBufferView(
        camera=view.camera,
        position=position.astype(np.float32),
        normal=normal,
        base_color=view.read("base_color") if view.has("base_color") else srgb_to_linear(image),
        roughness=view.read("roughness") if view.has("roughness") else np.full_like(depth, 0.5),
        metallic=view.read("metallic") if view.has("metallic") else np.zeros_like(depth),
        rgb=image,
        valid=valid,
        object_id=np.zeros(depth.shape, np.int32),
    )


def normals_of_depth(view: View, depth: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 unit normals, world, towards the camera, of a depth map (H, W); 0 where unknown.

    Of the two neighbours in a row or column the one nearer in depth is taken, so that edges stay sharp.
    """
    points = view.camera.position + depth[..., None].astype(np.float64) * view.camera.rays()
    known = depth > 0
    across, along = (_difference(points, depth, known, axis) for axis in (1, 0))
    normal = np.cross(along, across)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1), 0)
    towards = -(normal * view.camera.rays()).sum(-1, keepdims=True)
    return np.where(known[..., None], np.sign(towards) * normal, 0).astype(np.float32)


def _difference(points: np.ndarray, depth: np.ndarray, known: np.ndarray, axis: int) -> np.ndarray:
    """Difference to the neighbour, of the two, that is nearer in depth; 0 where neither is known."""
    ahead, behind = np.roll(points, -1, axis) - points, points - np.roll(points, 1, axis)
    jump = {}
    for name, shift, edge in (("ahead", -1, -1), ("behind", 1, 0)):
        gap = np.abs(np.roll(depth, shift, axis) - depth)
        fine = np.roll(known, shift, axis) & known
        np.moveaxis(fine, axis, 0)[edge] = False
        jump[name] = np.where(fine, gap, np.inf)
    chosen = np.where((jump["ahead"] <= jump["behind"])[..., None], ahead, behind)
    found = np.isfinite(np.minimum(jump["ahead"], jump["behind"]))
    return np.where(found[..., None], chosen, 0)
