"""Camera paths around things, from pole to grazing and from tele to wide, and paths that touch nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import KDTree

from datagen.world.objects import Placement
from datagen.world.paths import OscillatingPath, PathSpec, SpiralPath
from datagen.world.settling import Body
from datagen.world.shapes import Standing
from datagen.world.spec import Triple
from tron.errors import TronError

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


SAMPLES = 48
"""Places of a path that are looked at."""

TRIES = 40
LAST_TRIES = 600
"""Further paths, all of the easiest kind."""


class Obstacles:
    """Things and ground that cameras keep away from.

    Args:
        things: bodies with their places in the world.
        ground: what they stand on; its upper end is a ceiling.
    """

    def __init__(self, things: Sequence[tuple[Body, Placement]], ground: Standing) -> None:
        points = [np.empty((0, 3))]
        for body, spot in things:
            matrix = spot.matrix()
            points += [np.asarray(piece.vertices) @ matrix[:3, :3].T + matrix[:3, 3] for piece in body.pieces]
        cloud = np.concatenate(points)
        self._tree = KDTree(cloud) if len(cloud) else None
        self._ground = ground

    def leave(self, path: PathSpec, room: float, above: float) -> bool:
        """Whether a path keeps ``room`` from vertices, ``above`` from the ground, half from a ceiling."""
        places = np.array([camera.position for camera in path.cameras(SAMPLES, 8, 8)])
        if self._tree is not None and self._tree.query(places)[0].min() < room:
            return False
        ceiling = self._ground.high[2] - 0.5 * above
        return bool(
            (places[:, 2] >= self._ground.height(places[:, :2]) + above).all()
            and (places[:, 2] <= ceiling).all()
        )


def unhindered(
    rng: np.random.Generator,
    draw: Callable[[np.random.Generator, float], PathSpec],
    obstacles: Obstacles,
    room: float,
    above: float,
) -> PathSpec:
    """The first path that keeps away from everything.

    Args:
        rng: source of the paths.
        draw: draws one; its second argument grows from 0 to 1 as tries go by, to ask for an easier one.
        obstacles: what is kept away from.
        room, above: least distances from things and from the ground, world units; they shrink to a third.

    Raises:
        TronError: no path in TRIES and LAST_TRIES did.
    """
    for attempt in range(TRIES + LAST_TRIES):
        ease = min(attempt / (TRIES - 1), 1.0)
        path = draw(rng, ease)
        share = 1.0 - 0.67 * ease
        if obstacles.leave(path, share * room, share * above):
            return path
    raise TronError("no camera path leaves the things alone", mend="draw fewer objects")
