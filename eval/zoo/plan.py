"""Which individuals are in the zoo, and the materials of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from eval.zoo.materials import STRATA, WIDE_STRATA, Material, draw_materials
from eval.zoo.shapes import Shape, draw_shape
from tron.seeds import generator

INDIVIDUALS = 2
"""Of a kind but of balls, whose only proportion is one; they share the kind's materials."""
BALL, COLORS = "ball", 2
"""Materials of a ball of either metallic and each stratum."""


def individuals(kinds: Sequence[str], most: int | None, seed: int) -> Iterator[tuple[Shape, list[Material]]]:
    """Shapes with their materials, in the order of the wall.

    Args:
        kinds: of shapes.
        most: materials of an individual; None: all.
        seed: root of all random numbers.
    """
    for kind in kinds:
        rng = generator(seed, "zoo", "materials", kind)
        if kind == BALL:
            yield draw_shape(kind, 0, seed), _some(draw_materials(rng, STRATA, COLORS), most)
            continue
        materials = draw_materials(rng, WIDE_STRATA)
        for number in range(INDIVIDUALS):
            yield draw_shape(kind, number, seed), _some(materials[number::INDIVIDUALS], most)


def _some(materials: list[Material], most: int | None) -> list[Material]:
    """At most so many, evenly."""
    return materials if most is None else materials[:: -(-len(materials) // most)]
