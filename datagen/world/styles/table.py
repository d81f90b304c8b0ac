"""Style `table`: things set out, heaped or stacked on a table or a floor."""

from __future__ import annotations

import numpy as np

from datagen.world.settling import settle
from datagen.world.styles.cameras import around, from_all_sides
from datagen.world.styles.things import (
    CRATES,
    FOUND,
    GREEN,
    HARDWARE,
    PAPER,
    SHEETS,
    SIMPLE,
    SOFT,
    TOYS,
    VESSELS,
    WIRE,
    Choice,
    Composition,
    Streams,
    draw_things,
    fixture,
    placed,
)

GROUPS = (VESSELS, VESSELS, HARDWARE, TOYS, SIMPLE, PAPER, FOUND, SOFT, GREEN, WIRE, CRATES, SHEETS, SHEETS)
SIZE = (0.28, 0.7)
COUNT = (4, 9)
REACH = 1.3
"""Radius of the disk that things are dropped over, world units."""

TARGET = (0.0, 0.0, 0.25)
UNDER = (
    ("floor", 2.8 * 2**0.5),
    ("cobbles", 2.8 * 2**0.5),
    ("table_top", 2.6),
    ("round_table", 2.9),
    ("backdrop", 3.4),
)
"""What things stand on, and how large it is; no cobbles where the recipe names materials: it may be even."""


def table(streams: Streams, choice: Choice) -> Composition:
    """Draw a scene of some things on a table, a floor or a photographer's sweep.

    A third of the scenes have their things strewn about, the others drop most of them onto one heap or stack
    some, as hands and time leave them.

    Raises:
        TronError: nothing came to rest.
    """
    things = draw_things(streams("objects"), choice.objects or COUNT, GROUPS, SIZE, choice)
    rng = streams("surroundings")
    under = [each for each in UNDER if each[0] != "cobbles" or not choice.materials]
    kind, size = under[int(rng.integers(len(under)))]
    top = fixture(rng, kind, size, choice)
    rng = streams("layout")
    reach = min(REACH, 0.9 * float(np.abs([*top.ground.low[:2], *top.ground.high[:2]]).min()))
    heaped = int(len(things) * rng.choice([0.0, 0.5, 0.7]))
    how = "pile" if rng.random() < 0.6 else "stack"
    angle, far = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.0, 0.4) * reach
    heap = settle(
        rng,
        [thing.body for thing in things[:heaped]],
        top.ground,
        arrangement=how,
        centre=(far * np.cos(angle), far * np.sin(angle)),
        radius=0.35 * reach,
    )
    fixed = [(thing.body, spot) for thing, spot in zip(things, heap) if spot is not None]
    rest = settle(rng, [thing.body for thing in things[heaped:]], top.ground, radius=reach, fixed=fixed)
    objects, left_out = placed(things, [*heap, *rest])
    rng = streams("cameras")
    film = around(rng, TARGET, rng.uniform(1.2, 2.0), (20.0, 55.0), lowest_deg=6.0)
    return Composition((top.item,), objects, left_out, (from_all_sides(rng, TARGET, 2.0, 34.0),), film)
