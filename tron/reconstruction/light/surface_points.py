"""The surface points of a capture's views and the irradiance that a prior wants there, on the device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.captures import View
from tron.errors import TronError
from tron.reconstruction.geometry.seen_space import OPAQUE
from tron.reconstruction.progress import Track, untracked
from tron.runtime import aligned
from tron.seeds import generator
from tron.shading.guidance import ViewTracer

SKY = 0.5
"""Where the sky mask is at least this, the pixel is sky."""


def surface_mask(view: View, opacity: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels that show an opaque surface of the scene, and no sky."""
    counts = opacity > OPAQUE
    if view.has("sky_mask"):
        counts &= view.read("sky_mask") < SKY
    if view.has("mask"):
        counts &= view.read("mask") > OPAQUE
    counts &= view.believed()
    return counts


@dataclass
class PointBatch:
    """G-buffer of points for a fit of the light, with the wanted irradiance / pi.

    ``width`` makes a square of the points, whose neighbours then share out the strata of their rays.
    """

    position: mi.Point3f
    normal: mi.Normal3f
    opacity: mi.Float
    target: mi.Color3f
    width: int

    @property
    def pixel(self) -> mi.UInt32:
        """Place of each point in the square, row by row."""
        return dr.arange(mi.UInt32, dr.width(self.opacity))


class SurfacePoints:
    """Points of all views, one view after the other; the geometry is frozen, so they are traced once.

    Args:
        tracer: the scene.
        views: views with an irradiance map.
        per_view: most points kept of a view, drawn at random: 36 bytes each.
        seed: root of the draw.
        track: wraps the views, to show progress.

    Raises:
        TronError: no view shows any surface of the scene, or an irradiance map is wrong.
    """

    def __init__(
        self,
        tracer: ViewTracer,
        views: Sequence[View],
        per_view: int,
        seed: int,
        track: Track = untracked,
    ) -> None:
        parts: list[np.ndarray] = []
        for view in track(views, "G-buffers"):
            wanted = view.read("irradiance")  # first: a bad file is told before anything is traced
            buffers = tracer.gbuffer(view.camera).numpy()
            chosen = np.flatnonzero(surface_mask(view, buffers["opacity"]))
            if len(chosen) > per_view:
                draw = generator(seed, "environment", "points", view.name)
                chosen = np.sort(draw.choice(chosen, per_view, replace=False))
            if len(chosen):
                maps = (buffers["position"], buffers["normal"], wanted)
                parts.append(np.concatenate([image.reshape(-1, 3)[chosen] for image in maps], axis=1))
        if not parts:
            raise TronError(
                "no view shows a surface of the scene",
                mend="check that cameras and scene share one world, and that masks do not hide everything",
            )
        self.starts = np.cumsum([0] + [len(part) for part in parts])
        points = np.concatenate(parts)
        columns = [mi.Float(aligned(column)) for column in points.T]
        self._position, self._normal, self._target = columns[0:3], columns[3:6], columns[6:9]
        self.mean_target = points[:, 6:9].mean(0, dtype=np.float64)

    @property
    def views(self) -> int:
        """Views that show any surface."""
        return len(self.starts) - 1

    def batch(self, view: int, count: int, draw: np.random.Generator) -> PointBatch:
        """``count`` random points of a view, with repetition; all of them where it has no more."""
        first, end = self.starts[view], self.starts[view + 1]
        chosen = np.arange(first, end) if end - first <= count else draw.integers(first, end, count)
        index = mi.UInt32(aligned(chosen.astype(np.uint32)))
        position, normal, target = (
            [dr.gather(mi.Float, column, index) for column in columns]
            for columns in (self._position, self._normal, self._target)
        )
        opacity = dr.ones(mi.Float, len(chosen))
        width = math.isqrt(len(chosen) - 1) + 1
        return PointBatch(mi.Point3f(*position), mi.Normal3f(*normal), opacity, mi.Color3f(*target), width)
