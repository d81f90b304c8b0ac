"""Materials: a specification says what a surface looks like at every point of an object."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Union

import numpy as np
from pydantic import Field

from datagen.materials.bark import BarkSpec
from datagen.materials.brick import BrickSpec
from datagen.materials.ceramic import CeramicSpec
from datagen.materials.fabric import FabricSpec
from datagen.materials.ground import GroundSpec
from datagen.materials.leaf import LeafSpec
from datagen.materials.leather import LeatherSpec
from datagen.materials.marble import MarbleSpec
from datagen.materials.material import Appearance, Material, Solid
from datagen.materials.metal import MetalSpec
from datagen.materials.paint import PaintSpec
from datagen.materials.pattern import PatternSpec, draw_pattern
from datagen.materials.photographed import PhotographedSpec
from datagen.materials.plastic import PlasticSpec
from datagen.materials.printed import PrintSpec
from datagen.materials.rust import RustSpec
from datagen.materials.stone import StoneSpec
from datagen.materials.tiles import TilesSpec
from datagen.materials.wood import WoodSpec
from datagen.shapes.shape import Role

__all__ = [
    "FAMILIES",
    "SOLIDS",
    "Appearance",
    "Material",
    "MaterialSpec",
    "PatternSpec",
    "PhotographedSpec",
    "draw_material",
    "draw_pattern",
]

SOLIDS: tuple[type[Solid], ...] = (
    WoodSpec,
    StoneSpec,
    BrickSpec,
    TilesSpec,
    FabricSpec,
    MarbleSpec,
    MetalSpec,
    RustSpec,
    LeafSpec,
    BarkSpec,
    PrintSpec,
    PaintSpec,
    CeramicSpec,
    PlasticSpec,
    GroundSpec,
    LeatherSpec,
)
"""Families that roles choose from, each as likely as another; a new one changes what seeds give."""

FAMILIES: dict[str, type[Material]] = {
    str(material.model_fields["family"].default): material
    for material in (PatternSpec, *SOLIDS, PhotographedSpec)
}
"""Name -> family."""

if TYPE_CHECKING:
    MaterialSpec = Material
else:
    MaterialSpec = Annotated[Union[tuple(FAMILIES.values())], Field(discriminator="family")]  # noqa: UP007


def draw_material(rng: np.random.Generator, role: Role = "any", *, large: bool = False) -> Material:
    """Draw a material that suits a role; ``large``: for a floor or a wall, whose features are larger."""
    suited = [solid for solid in SOLIDS if role in solid.roles]
    return suited[int(rng.integers(len(suited)))].draw(rng, role, large=large)
