"""From how far around a capture shows what it looks at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tron.cameras import Camera, focus_of

HALF = 180.0
"""Degrees around, below which one side of a thing was seen by no photo."""


def seen_from_deg(cameras: Sequence[Camera], up: np.ndarray) -> float | None:
    """Degrees around the vertical from which cameras see what they look at: 360 less the widest gap.

    Args:
        cameras: of one world.
        up: (3,) unit, of that world.

    Returns:
        None where they look outwards, as in a room, or hardly move about the vertical.
    """
    focus, outward = focus_of([camera.camera_to_world for camera in cameras])
    if outward:
        return None
    across = np.stack([camera.position for camera in cameras]) - focus
    across -= np.outer(across @ up, up)
    east = np.cross(np.eye(3)[np.abs(up).argmin()], up)
    azimuth = np.sort(np.degrees(np.arctan2(across @ np.cross(up, east), across @ east)))
    if not np.linalg.norm(across, axis=1).any():
        return None
    return 360.0 - float(np.diff(azimuth, append=azimuth[0] + 360).max())
