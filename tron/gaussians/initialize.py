"""Surfels straight from G-buffers, without optimisation.

All pixels of all views are samples of the surface. A uniform grid, in which a cell also tells apart objects
and the six directions a surface can face, gathers them; each occupied cell becomes one surfel with the mean
position, normal and material of its samples. The cell size follows from the wanted count by bisection. A
surfel's scale is a fixed fraction of the distance to its neighbours on the same sheet, or, with ``detail``,
of its cell's sides, and cells are halved where they would blur most (:mod:`tron.gaussians.cells`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.special import logit

from tron.cameras import Camera
from tron.color import linear_to_srgb
from tron.errors import TronError
from tron.gaussians import cells
from tron.gaussians.harmonics import SH_COUNT, rgb_to_dc
from tron.gaussians.samples import Samples
from tron.gaussians.scene import (
    GaussianScene,
    neighbour_distances,
    quats_from_matrices,
    quats_from_normals,
)

# Surfels far from all others (grazing views, lone pixels) would cover their surroundings.
SCALE_CAP = 3.0
_SCALES = {2: 0.6, 4: 0.4}
"""By degree of the kernel: deviation of a surfel over the root mean square distance to the three nearest that
face the same way."""
_OPACITY = 0.99

# More samples than this are first merged in cells FINE times smaller than those of the surfels.
_SAMPLES_AT_ONCE = 2_000_000
_FINE = 4
# Measured while samples are merged: their values, keys, and what sorting takes.
_SAMPLE_BYTES = 200
_OBJECTS = 2**20
# Looked at to find three that face the same way.
_NEIGHBOURS = 12
_TRIALS = 24
_BY_AREA = 6  # of those trials, the first ones
_CLOSE_ENOUGH = 0.005

_CHANNELS = {"position": 3, "normal": 3, "base_color": 3, "roughness": 1, "metallic": 1, "rgb": 3}


@dataclass(eq=False)
class GBufferView:
    """View of one camera on a surface, by rays through the pixel centres.

    Never anti-aliased: a mean of two surfaces lies on neither.

    Attributes:
        camera: the view.
        position: (H, W, 3) world.
        normal: (H, W, 3) unit, world, on the camera's side of the surface.
        base_color: (H, W, 3) linear, in [0, 1].
        roughness, metallic: (H, W).
        rgb: (H, W, 3) radiance in display space, or None.
        valid: (H, W) bool, True where the ray hit a surface; elsewhere nothing is read.
        object_id: (H, W) int, in [0, 2**20).
    """

    camera: Camera
    position: np.ndarray
    normal: np.ndarray
    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    rgb: np.ndarray | None
    valid: np.ndarray
    object_id: np.ndarray


def surfels_from_gbuffers(
    views: Iterable[GBufferView],
    count: int = 20000,
    kernel_degree: int = 4,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    *,
    detail: bool = False,
) -> GaussianScene:
    """A scene of about ``count`` surfels through the surfaces that the views see.

    It does not depend on the order of the views, and holds fewer surfels only where the views have fewer
    samples. SH degree 0 is the views' mean rgb, display space, or else the sRGB-encoded base colour. Views
    may come one by one from an iterator: none is kept, and of their samples no more than
    :func:`sample_bytes`.

    Args:
        views: of one world.
        count: surfels wanted.
        kernel_degree: 2 or 4.
        up: (3,) unit, world.
        detail: surfels are smaller where base color, normals or materials vary, larger elsewhere, and have
            the shape of what they stand for. It takes half as long again.

    Raises:
        TronError: no view sees a surface, maps disagree in shape or are not finite, or only some of the views
            have rgb.
    """
    if count < 1:
        raise TronError(f"surfel count is {count}", mend="ask for at least one")
    samples = _gather(views, count)
    if not len(samples.weight):
        raise TronError("no view sees any surface, so there are no surfels to make")
    return _surfels(samples, count, kernel_degree, up, detail)


def surfels_from_points(
    values: dict[str, np.ndarray],
    object_id: int,
    count: int,
    kernel_degree: int = 4,
) -> GaussianScene:
    """The same of one object's points, which lie evenly on its surface.

    Args:
        values: position, normal (unit), base_color (linear), (N, 3) each, and roughness, metallic, (N, 1);
            emission (linear radiance), (N, 3), where something glows.
        object_id: of the surfels.
        count, kernel_degree: as of :func:`surfels_from_gbuffers`.
    """
    given = {name: np.asarray(array, np.float32) for name, array in values.items()}
    number = len(given["position"])
    samples = Samples(given, np.ones(number), np.full(number, object_id, np.int64))
    return _surfels(samples, count, kernel_degree)


def _surfels(
    samples: Samples,
    count: int,
    kernel_degree: int,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    detail: bool = False,
) -> GaussianScene:
    has_rgb = "rgb" in samples.values
    of_grid = round(cells.GRID_SHARE * count) if detail else count
    cell = samples.cells(_cell_size(samples, of_grid))
    if detail:
        cell = cells.halved(samples, cell, count)
    every, samples = samples, samples.merged(cell)
    means, normals = samples.values["position"], samples.values["normal"]
    distances = _sheet_distances(means, normals)
    spacing = float(np.median(distances)) or _extent(means) or 1.0
    distances = np.clip(distances, 1e-3 * spacing, SCALE_CAP * spacing)
    if detail:
        frames, sides = cells.axes(every, cell, samples, distances)
        quats = quats_from_matrices(frames)
    else:
        quats, sides = quats_from_normals(normals), np.repeat(distances[:, None], 2, axis=1)
    base_color = np.clip(samples.values["base_color"], 0, 1)
    sh = np.zeros((len(means), SH_COUNT, 3))
    sh[:, 0] = rgb_to_dc(samples.values["rgb"] if has_rgb else linear_to_srgb(base_color))
    return GaussianScene(
        means=means,
        quats=quats,
        log_scales=np.log(_SCALES[kernel_degree] * sides),
        opacity_logits=np.full(len(means), logit(_OPACITY)),
        sh=sh,
        base_color=base_color,
        roughness=np.clip(samples.values["roughness"][:, 0], 0, 1),
        metallic=np.clip(samples.values["metallic"][:, 0], 0, 1),
        object_id=samples.object_id,
        kernel_degree=kernel_degree,
        spacing=spacing,
        up=np.asarray(up),
        emission=samples.values.get("emission", np.empty((0, 3))),
    ).validate()


def sample_bytes(count: int, pixels: int) -> int:
    """Most memory that ``count`` surfels take while they are made from views of so many pixels in all."""
    return min(pixels, _bound(count)) * _SAMPLE_BYTES


def _bound(count: int) -> int:
    return max(_SAMPLES_AT_ONCE, 3 * _FINE**2 * count)


def _gather(views: Iterable[GBufferView], count: int) -> Samples:
    """All samples of all views; beyond a bound they are merged in cells much finer than the surfels'."""
    bound = _bound(count)
    parts: list[Samples] = []
    held, with_rgb, index = 0, 0, -1
    for index, view in enumerate(views):
        part = _samples(view, index)
        with_rgb += view.rgb is not None
        if with_rgb not in (0, index + 1):
            raise TronError(
                f"{with_rgb} of {index + 1} views have rgb", mend="give it in all views or in none"
            )
        parts.append(part)
        del view  # the next one is made while this function holds on to it
        held += len(part.weight)
        if held > bound:
            # The cell size only grows with what is still to be seen, so these cells stay fine enough.
            everything = Samples.joined(parts)
            parts = [everything.merged(everything.cells(_cell_size(everything, count) / _FINE))]
            held = len(parts[0].weight)
            del everything
    if index < 0:
        raise TronError("no views to make surfels from")
    return Samples.joined(parts)


def _samples(view: GBufferView, index: int) -> Samples:
    height, width = view.valid.shape
    valid = np.asarray(view.valid, dtype=bool)
    values = {}
    for name, channels in _CHANNELS.items():
        image = getattr(view, name)
        if image is None:
            continue
        if image.shape[:2] != (height, width) or image.size != height * width * channels:
            raise TronError(
                f"{name} of view {index} has shape {image.shape}, expected {height} x {width} pixels"
            )
        value = image[valid].reshape(-1, channels).astype(np.float32)
        if not np.isfinite(value).all():
            raise TronError(f"{name} of view {index} is not finite where the view is valid")
        values[name] = value
    lengths = np.linalg.norm(values["normal"], axis=1)
    if (np.abs(lengths - 1) > 1e-2).any():
        raise TronError(f"normals of view {index} are not unit vectors")
    object_id = np.asarray(view.object_id)[valid]
    if len(object_id) and not 0 <= object_id.min() <= object_id.max() < _OBJECTS:
        raise TronError(f"an object_id of view {index} is outside 0..{_OBJECTS - 1}")
    return Samples(values, np.ones(len(lengths)), object_id.astype(np.int64))


def _cell_size(samples: Samples, count: int) -> float:
    """The cell size, world units, for which about `count` cells are occupied.

    A surface occupies cells in proportion to the inverse square of their size: the next size follows from
    the number at the last one, in four or five trials; where it does not, the logarithm is bisected.
    """
    extent = _extent(samples.values["position"]) or 1.0
    # Below the first the integer keys could overflow; above the second everything is one cell.
    low, high = np.log(extent * 1e-4), np.log(extent * 4)
    middle = np.log(extent / np.sqrt(count))
    for trial in range(_TRIALS):
        middle = middle if trial <= _BY_AREA and low < middle < high else (low + high) / 2
        occupied = len(np.unique(samples.keys(np.exp(middle))))
        if abs(occupied - count) <= _CLOSE_ENOUGH * count:
            return float(np.exp(middle))
        low, high = (middle, high) if occupied > count else (low, middle)
        middle += np.log(occupied / count) / 2
    return float(np.exp(high))


def _extent(points: np.ndarray) -> float:
    return float(np.ptp(points, axis=0).max()) if len(points) else 0.0


def _sheet_distances(means: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Root mean square distance to the three nearest surfels that face the same way, (M,) float64.

    A surfel on the other side of a thin wall is near, but covers nothing of this one: counted as a neighbour
    it would shrink both sides into holes (2% of a thin sheet's pixels; 0.1% without it).
    """
    near = min(_NEIGHBOURS + 1, len(means))
    if near <= 3:
        return neighbour_distances(means)
    distances, index = KDTree(means).query(means, k=near)
    facing = np.einsum("mkc,mc->mk", normals[index], normals) > 0
    # Not the first column: a surfel and its twin on the other side may lie on one point.
    facing &= index != np.arange(len(means))[:, None]
    distances = np.sort(np.where(facing, distances, np.inf), axis=1)[:, :3]
    found = np.isfinite(distances)
    squares = np.where(found, distances, 0) ** 2
    alone = ~found.any(axis=1)
    if alone.any():
        squares[alone, 0] = neighbour_distances(means, np.flatnonzero(alone)) ** 2
    return np.sqrt(squares.sum(axis=1) / np.maximum(found.sum(axis=1), 1))
