"""Style `ground`: open land with things strewn about, the camera among them."""

from __future__ import annotations

import numpy as np

from datagen.world.paths import PathSpec, WalkPath
from datagen.world.settling import settle
from datagen.world.styles.cameras import Obstacles, around, from_all_sides, unhindered
from datagen.world.styles.things import (
    CRATES,
    FOUND,
    GREEN,
    SHEETS,
    STONEWORK,
    WIRE,
    Choice,
    Composition,
    Streams,
    draw_things,
    fixture,
    placed,
)

LARGE, SMALL = (0.5, 1.0), (0.15, 0.45)
COUNT = (7, 13)
SIZE = 5.0
"""Radius of the ball that the land fits."""

REACH = 2.2
TARGET = (0.0, 0.0, 0.35)
ROOM, ABOVE = 0.3, 0.25
"""Least distances of a camera from things and from the ground, world units."""


def ground(streams: Streams, choice: Choice) -> Composition:
    """Draw a piece of land: a few large things, more small ones.

    Raises:
        TronError: nothing came to rest, or no camera found a way.
    """
    land = fixture(streams("surroundings"), "terrain", SIZE, choice)
    rng = streams("objects")
    low, high = choice.objects or COUNT
    number = int(rng.integers(low, high + 1))
    large = (number + 2) // 3
    groups = (STONEWORK, FOUND, GREEN, CRATES, WIRE, SHEETS)
    things = draw_things(rng, (large, large), (*groups, ("tree", "bench", "chair")), LARGE, choice)
    things += draw_things(rng, (number - large, number - large), groups, SMALL, choice)
    rest = settle(streams("layout"), [thing.body for thing in things], land.ground, radius=REACH)
    objects, left_out = placed(things, rest)
    obstacles = Obstacles(
        [(thing.body, spot) for thing, spot in zip(things, rest) if spot is not None], land.ground
    )
    rng = streams("cameras")

    def film(rng: np.random.Generator, ease: float) -> PathSpec:
        if rng.random() < 0.5:
            return around(rng, TARGET, rng.uniform(1.3, 2.4), (34.0, 62.0), lowest_deg=6.0 + 20.0 * ease)
        return _way(rng, ease)

    path = unhindered(rng, film, obstacles, ROOM, ABOVE)
    capture = (
        from_all_sides(rng, TARGET, 2.6, 44.0),
        unhindered(rng, _round, obstacles, ROOM, ABOVE),
    )
    return Composition((land.item,), objects, left_out, capture, path)


def _way(rng: np.random.Generator, ease: float) -> WalkPath:
    """A way past the things at the height of a knee to that of an eye."""
    start, turn = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.6, 2.0) * (1.0 - 0.5 * ease)
    positions, targets = [], []
    for k in range(4):
        angle, far = start + turn * k / 3, rng.uniform(1.6, 2.8)
        positions.append((far * np.cos(angle), far * np.sin(angle), rng.uniform(0.6, 1.5) + 0.8 * ease))
        targets.append((*rng.uniform(-0.6, 0.6, 2), rng.uniform(0.1, 0.5)))
    return WalkPath(fov_deg=rng.uniform(45.0, 70.0), positions=tuple(positions), targets=tuple(targets))


def _round(rng: np.random.Generator, ease: float) -> WalkPath:
    """Once around the middle at the height of an eye, looking across."""
    start, far, level = rng.uniform(0.0, 2 * np.pi), rng.uniform(2.0, 2.6), 0.9 + ease
    angles = start + 2 * np.pi * np.arange(13) / 12
    positions = [(far * np.cos(a), far * np.sin(a), level) for a in angles]
    targets = [(-0.4 * far * np.cos(a), -0.4 * far * np.sin(a), 0.2) for a in angles]
    return WalkPath(fov_deg=66.0, positions=tuple(positions), targets=tuple(targets))
