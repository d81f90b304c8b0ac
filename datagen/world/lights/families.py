"""The table of light families: their names in recipes, and their specifications."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Annotated, Literal, TypeGuard, Union

import numpy as np
from pydantic import Field

from datagen.world.lights.hdri import HdriSpec
from datagen.world.lights.light import Light
from tron.shading.environments.contrast import CONTRAST_ROWS, INTERVALS, Contrast, contrast_share


def _is_light(each: object) -> TypeGuard[type[Light]]:
    return isinstance(each, type) and issubclass(each, Light)


def _families() -> dict[str, type[Light]]:
    found: dict[str, type[Light]] = {}
    for file in iter_modules([str(Path(__file__).parent)]):
        if file.name == "families":
            continue
        for each in vars(import_module(f"datagen.world.lights.{file.name}")).values():
            name = each.model_fields["family"].default if _is_light(each) else None
            if isinstance(name, str):  # a base that families share has none
                found[name] = each
    return dict(sorted(found.items(), key=lambda item: (item[1].number, item[0])))


FAMILIES = _families()
"""Name -> family: every subclass of Light in this folder that has a name, in the order of their numbers."""

EVERY = tuple(name for name in FAMILIES if name != "hdri")
"""All families that need no files: what classes of contrast choose from."""

USUAL = tuple(
    name
    for places in sorted({light.usual for light in FAMILIES.values()}, reverse=True)
    for name in places * [name for name, light in FAMILIES.items() if light.usual == places]
)
"""Families that ``any`` chooses from, one place as likely as another."""

if TYPE_CHECKING:
    LightSpec = Light
    Family = LightChoice = str
else:
    LightSpec = Annotated[Union[tuple(FAMILIES.values())], Field(discriminator="family")]  # noqa: UP007
    Family = Literal[tuple(FAMILIES)]
    LightChoice = Literal["any", "high", "medium", "low", *FAMILIES]


TRIES = 24
"""Lights that are drawn for a class before the nearest of them is taken."""

MARGIN = 0.015
"""Distance of a share from its class's ends: neither another resolution nor a last bit changes the class."""


def draw_light(
    rng: np.random.Generator,
    wanted: LightChoice,
    families: Sequence[Family],
    files: Sequence[HdriSpec] = (),
) -> Light:
    """Draw a light.

    Args:
        rng: the light's own stream.
        wanted: a family, ``any`` of ``families``, or a class: ``high``, ``medium`` or ``low`` contrast. A
            light of a class is drawn from ``families`` until one measures so, at most TRIES times; then the
            nearest is taken. Skies need Mitsuba's variant to be measured.
        families: what ``any`` and classes choose from.
        files: the user's maps; a class takes those of it. Where ``families`` are these alone and none
            is, procedural ones stand in.
    """
    if wanted not in INTERVALS:
        family = families[int(rng.integers(len(families)))] if wanted == "any" else wanted
        return FAMILIES[family].draw(rng, files)
    suiting = [each for each in files if each.contrast == wanted]
    pool = [name for name in families if suiting or name != "hdri"] or EVERY
    drawn: list[tuple[float, Light]] = []
    for _ in range(TRIES):
        light = FAMILIES[pool[int(rng.integers(len(pool)))]].draw(rng, suiting)
        drawn.append((distance(light, wanted), light))
        if drawn[-1][0] == 0.0:
            break
    return min(drawn, key=lambda each: each[0])[1]


def distance(light: Light, wanted: Contrast) -> float:
    """Distance of a light's contrast from the inside of a class; a file's class was measured before."""
    if isinstance(light, HdriSpec):
        return float(light.contrast != wanted)
    low, high = INTERVALS[wanted]
    share = contrast_share(light.bake(CONTRAST_ROWS))
    inner = (low + MARGIN if low > 0.0 else 0.0, high - MARGIN if high < 1.0 else 1.0)
    return max(inner[0] - share, share - inner[1], 0.0)
