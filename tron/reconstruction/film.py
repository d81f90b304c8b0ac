"""Film a scan: render its surfels for cameras, as the views of a capture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.gaussians.scene import GaussianScene
from tron.reconstruction.progress import Track, untracked
from tron.relighting.proxy import seen_by
from tron.tracing import SurfelTracer

THIN = 0.02
"""Opacity below which a pixel's colour is not known."""


def film(scan: GaussianScene, cameras: Sequence[Camera], track: Track = untracked) -> list[View]:
    """Render views of a scan: display values, its opacity as their mask, and median depths."""
    tracer, views = SurfelTracer(scan), []
    for number, camera in enumerate(track(cameras, "filming splats")):
        buffers = seen_by(tracer, camera).numpy()
        mask = np.clip(buffers["opacity"], 0, 1)
        maps = {"mask": mask, "depth": buffers["depth"]}
        views.append(View(f"film_{number:05d}", camera, straight_color(buffers), "display", **maps))
    return views


def straight_color(buffers: Mapping[str, np.ndarray]) -> np.ndarray:
    """(H, W, 3) display colours of a G-buffer's arrays, black where next to nothing is."""
    opacity = np.clip(buffers["opacity"], 0, 1)
    solid = opacity > THIN
    color = buffers["rgb"] / np.where(solid, opacity, 1)[..., None]
    return np.where(solid[..., None], np.clip(color, 0, 1), 0)


def film_of_scan(scan: GaussianScene, cameras: Sequence[Camera], track: Track = untracked) -> Capture:
    """Make the capture of a scan whose surfels are kept; no view is held out."""
    return Capture(tuple(film(scan, cameras, track)), up=scan.up, offset=scan.offset, scan=scan)
