"""Style `room`: furniture between four walls; light enters by windows and doors."""

from __future__ import annotations

from functools import partial

import numpy as np

from datagen.world.paths import WalkPath
from datagen.world.settling import settle
from datagen.world.shapes import Standing
from datagen.world.styles.cameras import Obstacles, unhindered
from datagen.world.styles.things import (
    CRATES,
    FURNITURE,
    GREEN,
    PAPER,
    SHEETS,
    SOFT,
    VESSELS,
    Choice,
    Composition,
    Streams,
    draw_things,
    fixture,
    placed,
)

LARGE, SMALL = (0.5, 0.85), (0.2, 0.42)
COUNT = (4, 8)
SIZE = (4.0, 4.6)
"""Radius of the ball that a room fits: a metre is a little more than one unit."""

ROOM, ABOVE = 0.3, 0.35
"""Least distances of a camera from things and from the floor, world units."""


def room(streams: Streams, choice: Choice) -> Composition:
    """Draw a room: half of its things are furniture, the others lie and stand about.

    Raises:
        TronError: nothing came to rest, or no camera found a way.
    """
    rng = streams("surroundings")
    shell = fixture(rng, "room_shell", rng.uniform(*SIZE), choice)
    rng = streams("objects")
    low, high = choice.objects or COUNT
    number = int(rng.integers(low, high + 1))
    large = (number + 1) // 2
    things = draw_things(rng, (large, large), (FURNITURE,), LARGE, choice)
    things += draw_things(
        rng, (number - large, number - large), (CRATES, GREEN, PAPER, SHEETS, SOFT, VESSELS), SMALL, choice
    )
    reach = 0.8 * float(np.abs([*shell.ground.low[:2], *shell.ground.high[:2]]).min())
    rest = settle(streams("layout"), [thing.body for thing in things], shell.ground, radius=reach)
    objects, left_out = placed(things, rest)
    obstacles = Obstacles(
        [(thing.body, spot) for thing, spot in zip(things, rest) if spot is not None], shell.ground
    )
    rng = streams("cameras")
    film = unhindered(rng, partial(_stroll, shell.ground), obstacles, ROOM, ABOVE)
    capture = tuple(
        unhindered(rng, partial(_round, shell.ground, height, inward), obstacles, ROOM, ABOVE)
        for height, inward in ((0.3, True), (0.62, True), (0.6, False))
    )
    return Composition((shell.item,), objects, left_out, capture, film, metered=True)


def _stroll(ground: Standing, rng: np.random.Generator, ease: float) -> WalkPath:
    """A walk along a part of the walls at the height of an eye or a lifted hand, looking in."""
    half = 0.5 * (ground.high - ground.low)[:2]
    start, sweep = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.5, 1.8) * (1.0 - 0.6 * ease)
    near, height = rng.uniform(0.5, 0.8), rng.uniform(0.3, 0.6 + 0.15 * ease)
    positions, targets = [], []
    for k in range(4):
        angle = start + sweep * k / 3
        x, y = near * half * (np.cos(angle), np.sin(angle))
        positions.append((x, y, (height + rng.uniform(-0.05, 0.05)) * ground.high[2]))
        ahead = rng.uniform(-0.35, 0.35, 2) * half
        targets.append((*ahead, rng.uniform(0.1, 0.4) * ground.high[2]))
    return WalkPath(fov_deg=rng.uniform(50.0, 78.0), positions=tuple(positions), targets=tuple(targets))


def _round(ground: Standing, height: float, inward: bool, rng: np.random.Generator, ease: float) -> WalkPath:
    """A walk once around the room, looking across it; or a turn in its middle, looking at its walls."""
    half = 0.5 * (ground.high - ground.low)[:2]
    start, share = rng.uniform(0.0, 2 * np.pi), 0.78 if inward else 0.25
    level = (height + (0.78 - height) * ease) * ground.high[2]
    positions, targets = [], []
    for k in range(13):
        angle = start + 2 * np.pi * k / 12
        side = np.array([np.cos(angle), np.sin(angle)])
        x, y = share * half * side
        positions.append((x, y, level))
        there = (-0.5 if inward else 1.0) * half * side
        targets.append((*there, (0.1 + 0.5 * (k % 3) / 2) * ground.high[2]))
    return WalkPath(fov_deg=82.0, positions=tuple(positions), targets=tuple(targets))
