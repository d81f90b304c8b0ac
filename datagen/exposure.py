"""Exposure of a clip: for its light, or, indoors, for what its first frame shows."""

from __future__ import annotations

import numpy as np

from tron.color import luminance

GREY = 0.1
"""Median luminance of a metered frame, which AgX shows a little darker than middle grey."""

THIRDS = 3
"""Steps in a stop: as on a camera, which also keeps rounding errors of a frame out of its clip's exposure."""

MOST_STOPS = 6


def metered(frame: np.ndarray, foreground: np.ndarray, exposure: float) -> float:
    """Exposure at which a frame's median is GREY, no lower than the light's own.

    Rooms are darker than what lights them: exposed for the sky, all of them would be black. Pixels that are
    not finite do not count: their clip is set aside by name, and needs an exposure until then.

    Args:
        frame: (H, W, 3) linear radiance.
        foreground: (H, W) bool, pixels that show a surface; none of them leaves the exposure as it is.
        exposure: of the light (:meth:`tron.shading.environment.EnvironmentMap.exposure`).
    """
    seen = luminance(frame[foreground]) * exposure
    seen = seen[np.isfinite(seen)]
    middle = float(np.median(seen)) if seen.size else GREY
    stops = np.log2(GREY / max(middle, 1e-12))
    return exposure * 2.0 ** (np.floor(np.clip(stops, 0.0, MOST_STOPS) * THIRDS) / THIRDS)
