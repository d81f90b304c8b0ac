"""Sky in a view: nothing near, above the horizon, bright or blue."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tron.captures import Capture, View
from tron.captures.open_sky import sky_coloured

_OPAQUE = 0.5


def sky_mask(
    view: View, light: np.ndarray, geometry: Mapping[str, np.ndarray], up: np.ndarray, reach: float
) -> np.ndarray:
    """(H, W) float32, 1 on the sky, 0 elsewhere.

    A pixel is sky if no surface is there (opacity below one half) or only one beyond ``reach``, where
    reconstructions paint skies; if its ray rises; and if its colour is brighter than half the view's pixels,
    or blue. Skies in mirrors are not sky, nor is one seen below the camera's horizon.

    Args:
        view: its camera and size.
        light: (H, W, 3) linear light of its image.
        geometry: opacity and depth (H, W) as the surfels show them.
        up: (3,) unit, world.
        reach: distance from the camera, world units.
    """
    nothing = (geometry["opacity"] < _OPAQUE) | (geometry["depth"] > reach)
    rises = view.camera.rays() @ up > 0
    return (nothing & rises & sky_coloured(light)).astype(np.float32)


def capture_radius(capture: Capture) -> float:
    """Median distance of the cameras to their median position, world units; infinite if none moves."""
    positions = np.stack([view.camera.position for view in capture.views])
    radius = float(np.median(np.linalg.norm(positions - np.median(positions, axis=0), axis=1)))
    return radius or float("inf")
