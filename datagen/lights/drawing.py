"""A light as a recipe asks for it: of a family, of any, or of a class of contrast."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datagen.lights.contrast import CONTRAST_ROWS, INTERVALS, Contrast, contrast_share
from datagen.lights.families import EVERY, FAMILIES, Family, LightChoice
from datagen.lights.hdri import HdriSpec
from datagen.lights.light import Light

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
