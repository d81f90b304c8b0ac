"""Camera paths around things: from pole to grazing, level orbits, close looks; lenses from tele to wide."""

from __future__ import annotations

import numpy as np

from datagen.paths import OscillatingPath, SpiralPath
from datagen.spec import Triple

GRAZING_DEG = 4.0
POLE_DEG = 84.0
"""Lowest and highest elevation of a camera: beyond them views are all floor's edge, or all alike."""


def around(
    rng: np.random.Generator,
    target: Triple,
    extent: float,
    lens_deg: tuple[float, float],
    lowest_deg: float = GRAZING_DEG,
) -> OscillatingPath:
    """Draw a path around a subject: half of them swing between pole and grazing, the others keep a level.

    Args:
        rng: source of the path.
        target: what is looked at, world.
        extent: radius around the target that fills the image's width, world units.
        lens_deg: least and greatest horizontal field of view; cameras stand as near as it lets them.
        lowest_deg: elevation below which no camera goes.
    """
    fov = rng.uniform(*lens_deg)
    radius = extent / np.tan(np.radians(0.5 * fov))
    start = rng.uniform(0.0, 360.0)
    turn = (1.0 if rng.random() < 0.5 else -1.0) * rng.uniform(150.0, 340.0)
    if rng.random() < 0.5:
        middle = rng.uniform(0.35, 0.65) * (lowest_deg + POLE_DEG)
        amplitude = rng.uniform(0.6, 1.0) * min(middle - lowest_deg, POLE_DEG - middle)
    else:
        middle = np.degrees(np.arcsin(rng.uniform(np.sin(np.radians(lowest_deg + 4.0)), 0.85)))
        amplitude = rng.uniform(0.0, 0.6) * min(middle - lowest_deg, 6.0)
    return OscillatingPath(
        target=target,
        fov_deg=fov,
        radius=radius,
        elevation_deg=middle,
        amplitude_deg=amplitude,
        azimuth_deg=(start, start + turn),
        swings=rng.uniform(0.5, 2.0),
    )


def from_all_sides(rng: np.random.Generator, target: Triple, extent: float, fov_deg: float) -> SpiralPath:
    """The spiral that surfels of a subject are made from, from grazing to pole."""
    return SpiralPath(
        target=target,
        fov_deg=fov_deg,
        radius=extent / np.tan(np.radians(0.5 * fov_deg)),
        elevation_deg=(GRAZING_DEG, 80.0),
        turns=4.0,
        phase_deg=rng.uniform(0.0, 360.0),
    )
