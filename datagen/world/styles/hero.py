"""Style `object`: one thing, close, as a product or a find is photographed."""

from __future__ import annotations

import numpy as np

from datagen.world.settling import settle
from datagen.world.styles.cameras import around, from_all_sides
from datagen.world.styles.things import (
    FOUND,
    FURNITURE,
    GREEN,
    HARDWARE,
    PAPER,
    SHEETS,
    SIMPLE,
    SOFT,
    STONEWORK,
    TOYS,
    VESSELS,
    WIRE,
    Choice,
    Composition,
    Streams,
    draw_things,
    fixture,
    placed,
    top_of,
)

GROUPS = (
    *(VESSELS, HARDWARE, TOYS, SIMPLE, PAPER, FOUND, SOFT, GREEN, WIRE, FURNITURE, STONEWORK, ("tree",)),
    *(SHEETS, SHEETS),
)
SIZE = (0.9, 1.3)
FLOOR = 2.4
"""Half side of the floor, world units."""

UNDER = ("floor", "floor", "floor", "cobbles")
"""What it stands on, one as likely as another; a floor where the recipe names materials: they may be even."""


def hero(streams: Streams, choice: Choice) -> Composition:
    """Draw a scene of one thing, or of as many as the recipe asks for, on a floor.

    Raises:
        TronError: nothing came to rest.
    """
    things = draw_things(streams("objects"), choice.objects or (1, 1), GROUPS, SIZE, choice)
    rng = streams("surroundings")
    kind = "floor" if choice.materials else UNDER[int(rng.integers(len(UNDER)))]
    floor = fixture(rng, kind, FLOOR * np.sqrt(2.0), choice)
    rest = settle(streams("layout"), [thing.body for thing in things], floor.ground, radius=0.3 * len(things))
    objects, left_out = placed(things, rest)
    target = (0.0, 0.0, 0.5 * top_of(objects))
    rng = streams("cameras")
    film = around(rng, target, rng.uniform(1.1, 1.7), (18.0, 50.0))
    return Composition((floor.item,), objects, left_out, (from_all_sides(rng, target, 1.9, 34.0),), film)
