"""Room that a camera needs: paths that touch neither things nor ground, found by trial."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import KDTree

from datagen.layout import Placement
from datagen.paths import PathSpec
from datagen.settling import Body
from datagen.shapes import Standing
from tron.errors import TronError

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
