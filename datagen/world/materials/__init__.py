"""Materials: a specification says what a surface looks like at every point of an object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal, Union

import numpy as np
from pydantic import Field

from datagen.world.materials.bark import BarkSpec
from datagen.world.materials.brick import BrickSpec
from datagen.world.materials.ceramic import CeramicSpec
from datagen.world.materials.fabric import FabricSpec
from datagen.world.materials.ground import GroundSpec
from datagen.world.materials.leaf import LeafSpec
from datagen.world.materials.leather import LeatherSpec
from datagen.world.materials.marble import MarbleSpec
from datagen.world.materials.material import Appearance, Material, Solid
from datagen.world.materials.metal import MetalSpec
from datagen.world.materials.paint import PaintSpec
from datagen.world.materials.photographed import PhotographedSpec
from datagen.world.materials.plastic import PlasticSpec
from datagen.world.materials.printed import PrintSpec
from datagen.world.materials.rust import RustSpec
from datagen.world.materials.stone import StoneSpec
from datagen.world.materials.tiles import TilesSpec
from datagen.world.materials.wood import WoodSpec
from datagen.world.shapes.shape import Role

__all__ = [
    "FAMILIES",
    "SOLIDS",
    "Appearance",
    "Material",
    "MaterialSpec",
    "PhotographedSpec",
    "ProceduralName",
    "draw_material",
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


def name_of(family: type[Material]) -> str:
    """Name of a family in specifications and recipes."""
    return str(family.model_fields["family"].default)


FAMILIES: dict[str, type[Material]] = {name_of(family): family for family in (*SOLIDS, PhotographedSpec)}
"""Name -> family."""

if TYPE_CHECKING:
    ProceduralName = str
else:
    ProceduralName = Literal[tuple(map(name_of, SOLIDS))]
    """Name of a family that is drawn from seeds."""

if TYPE_CHECKING:
    MaterialSpec = Material
else:
    MaterialSpec = Annotated[Union[tuple(FAMILIES.values())], Field(discriminator="family")]  # noqa: UP007


def draw_material(
    rng: np.random.Generator, role: Role = "any", *, large: bool = False, families: Sequence[str] = ()
) -> Material:
    """Draw a material that suits a role.

    Args:
        rng: source of the family and of its parameters.
        role: what it is made into.
        large: for a floor or a wall, whose features are larger.
        families: names of the families to choose from, of SOLIDS; those that suit the role, or all of them
            where none does. Empty: any that suits.
    """
    allowed = [solid for solid in SOLIDS if not families or name_of(solid) in families]
    suited = [solid for solid in allowed if role in solid.roles] or allowed
    return suited[int(rng.integers(len(suited)))].draw(rng, role, large=large)
