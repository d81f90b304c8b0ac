"""Light families: a drawn specification becomes one lat-long environment map.

A family is one subclass of :class:`Light` in a file of its own: what a recipe may ask for, what
specifications are read as and what clips say of their light follow from FAMILIES, which finds it.

The same image lights Mitsuba's path tracer and the surfels, so whatever the bake rounds off is rounded off in
both.
"""

from datagen.world.lights.families import (
    EVERY,
    FAMILIES,
    USUAL,
    Family,
    LightChoice,
    LightSpec,
    draw_light,
)
from datagen.world.lights.hdri import HdriSpec
from datagen.world.lights.light import Light
from datagen.world.lights.overcast import OvercastSpec
from datagen.world.lights.studio import Panel, StudioSpec
from datagen.world.lights.sun import SunSpec
from tron.shading.environments.contrast import Contrast, classify, contrast_share

__all__ = [
    "EVERY",
    "FAMILIES",
    "USUAL",
    "Contrast",
    "Family",
    "HdriSpec",
    "Light",
    "LightChoice",
    "LightSpec",
    "OvercastSpec",
    "Panel",
    "StudioSpec",
    "SunSpec",
    "classify",
    "contrast_share",
    "draw_light",
]
