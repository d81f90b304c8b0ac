"""How far around its subject a capture's cameras reach."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tron.cameras import Camera, focus_of

HALF = 180.0
"""Degrees around, below which one side of a thing was seen by no photo."""
_STEEP = 0.1  # sine of the angle to the vertical below which a camera looks from above alone


def seen_from_deg(cameras: Sequence[Camera], up: np.ndarray) -> float | None:
    """Degrees around the vertical from which cameras see what they look at: 360 less the widest gap.

    Args:
        cameras: of one world.
        up: (3,) unit, of that world.

    Returns:
        None where they look outwards, as in a room, or from straight above.
    """
    focus, outward = focus_of([camera.camera_to_world for camera in cameras])
    if outward:
        return None
    across = np.stack([camera.position for camera in cameras]) - focus
    distance = np.linalg.norm(across, axis=1)
    across -= np.outer(across @ up, up)
    if np.median(np.linalg.norm(across, axis=1)) < _STEEP * np.median(distance):
        return None
    east = np.cross(np.eye(3)[np.abs(up).argmin()], up)
    azimuth = np.sort(np.degrees(np.arctan2(across @ np.cross(up, east), across @ east)))
    return 360.0 - float(np.diff(azimuth, append=azimuth[0] + 360).max())
