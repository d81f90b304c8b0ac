"""Styles of scenes: what stands there, on what, and how it is filmed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from datagen.styles.arrangement import Arrangement, Choice, Streams
from datagen.styles.primitives import STYLE_A, STYLE_B

__all__ = ["MIXED", "OLD", "STYLES", "Arrangement", "Choice", "Streams", "Style", "StyleChoice"]

STYLES: dict[str, Callable[[Streams, Choice], Arrangement]] = {"A": STYLE_A, "B": STYLE_B}
"""Name -> style."""

OLD = ("A", "B")
"""Styles that draw what they always drew: among other things a place of its own for each light's clip."""

MIXED = tuple(name for name in STYLES if name not in OLD)
"""Styles that ``mixed`` draws from."""

if TYPE_CHECKING:
    Style = StyleChoice = str
else:
    Style = Literal[tuple(STYLES)]
    StyleChoice = Literal[tuple(STYLES)]
