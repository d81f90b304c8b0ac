"""Styles of scenes: what stands there, on what, and how it is filmed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from datagen.styles.composition import Choice, Composition, Streams
from datagen.styles.ground import ground
from datagen.styles.hero import hero
from datagen.styles.primitives import STYLE_A, STYLE_B
from datagen.styles.room import room
from datagen.styles.table import table

__all__ = ["MIXED", "OLD", "STYLES", "Choice", "Composition", "Streams", "Style", "StyleChoice"]


STYLES: dict[str, Callable[[Streams, Choice], Composition]] = {
    "A": STYLE_A,
    "B": STYLE_B,
    "object": hero,
    "table": table,
    "room": room,
    "ground": ground,
}
"""Name -> style."""

OLD = ("A", "B")
"""Styles that draw what they always drew: among other things a place of its own for each light's clip."""

MIXED = ("object", "object", "table", "table", "table", "room", "ground")
"""Styles that ``mixed`` draws from, one as likely as another."""

if TYPE_CHECKING:
    Style = StyleChoice = str
else:
    Style = Literal[tuple(STYLES)]
    StyleChoice = Literal["mixed", *STYLES]
