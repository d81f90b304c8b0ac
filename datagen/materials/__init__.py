"""Materials: a specification says what a surface looks like at every point of an object."""

from __future__ import annotations

from typing import TYPE_CHECKING, Union

from datagen.materials.material import Appearance, Material
from datagen.materials.pattern import PatternSpec, draw_pattern

__all__ = ["FAMILIES", "Appearance", "Material", "MaterialSpec", "PatternSpec", "draw_pattern"]

FAMILIES: dict[str, type[Material]] = {
    str(material.model_fields["family"].default): material for material in (PatternSpec,)
}
"""Name -> family."""

if TYPE_CHECKING:
    MaterialSpec = Material
else:
    MaterialSpec = Union[tuple(FAMILIES.values())]  # noqa: UP007
