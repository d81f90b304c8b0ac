"""Styles of scenes: objects, their support, and camera paths."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from datagen.world.styles.ground import ground
from datagen.world.styles.hero import hero
from datagen.world.styles.room import room
from datagen.world.styles.table import table
from datagen.world.styles.things import Choice, Composition, Streams

__all__ = ["MIXED", "STYLES", "Choice", "Composition", "Streams", "Style", "StyleChoice"]


STYLES: dict[str, Callable[[Streams, Choice], Composition]] = {
    "object": hero,
    "table": table,
    "room": room,
    "ground": ground,
}
"""Name -> style."""

MIXED = ("object", "object", "table", "table", "table", "room", "ground")
"""Styles that ``mixed`` draws from, one as likely as another."""

if TYPE_CHECKING:
    Style = StyleChoice = str
else:
    Style = Literal[tuple(STYLES)]
    StyleChoice = Literal["mixed", *STYLES]
