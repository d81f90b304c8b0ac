"""The table of families: what a recipe may ask for, and what specifications are read as."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Union

from pydantic import Field

from datagen.lights.clouds import CloudsSpec
from datagen.lights.coloured import ColouredSpec
from datagen.lights.hdri import HdriSpec
from datagen.lights.interior import InteriorSpec
from datagen.lights.landscape import LandscapeSpec
from datagen.lights.light import Light
from datagen.lights.night import NightSpec
from datagen.lights.overcast import OvercastSpec
from datagen.lights.studio import StudioSpec
from datagen.lights.sun import SunSpec

FAMILIES: dict[str, type[Light]] = {
    str(light.model_fields["family"].default): light
    for light in (
        *(SunSpec, StudioSpec, OvercastSpec, HdriSpec),
        *(CloudsSpec, LandscapeSpec, InteriorSpec, NightSpec, ColouredSpec),
    )
}
"""Name -> family, in the order in which ``any`` numbers them: new ones come last."""

PROCEDURAL = tuple(name for name, light in FAMILIES.items() if light.in_any)
"""Families that ``any`` chooses from in styles A and B, unless a recipe names others."""

EVERY = tuple(name for name in FAMILIES if name != "hdri")
"""All families that need no files: what classes of contrast choose from."""

USUAL = (
    *(3 * ("clouds", "landscape", "interior")),
    *(2 * ("sun", "studio")),
    *("overcast", "night", "coloured"),
)
"""Families that ``any`` chooses from in every other style, one place as likely as another."""

if TYPE_CHECKING:
    LightSpec = Light
    Family = LightChoice = str
else:
    LightSpec = Annotated[Union[tuple(FAMILIES.values())], Field(discriminator="family")]  # noqa: UP007
    Family = Literal[tuple(FAMILIES)]
    LightChoice = Literal["any", "high", "medium", "low", *FAMILIES]
