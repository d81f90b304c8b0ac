"""Sky in a view: nothing near, above the horizon, bright or blue."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tron.captures import Capture, View
from tron.color import luminance

_OPAQUE = 0.5
_BLUE = 1.1  # blue over red
_DARK = 0.02  # linear; darker pixels have no colour to speak of


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
    brightness = luminance(light)
    bright = brightness > np.median(brightness)
    blue = (light[..., 2] > _BLUE * light[..., 0]) & (light[..., 2] >= light[..., 1])
    coloured = (bright | blue) & (brightness > _DARK)
    return (nothing & rises & coloured).astype(np.float32)


def capture_radius(capture: Capture) -> float:
    """Median distance of the cameras to their median position, world units; infinite if none moves."""
    positions = np.stack([view.camera.position for view in capture.views])
    radius = float(np.median(np.linalg.norm(positions - np.median(positions, axis=0), axis=1)))
    return radius or float("inf")
