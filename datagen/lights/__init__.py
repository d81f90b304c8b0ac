"""Light families: a drawn specification becomes one lat-long environment map.

A family is one subclass of :class:`Light` in a file of its own, named in FAMILIES: what a recipe may ask for,
what specifications are read as and what clips say of their light follow from that table.

The same image lights Mitsuba's path tracer and the surfels, so whatever the bake rounds off is rounded off in
both.
"""

from datagen.lights.contrast import Contrast, classify, contrast_share
from datagen.lights.drawing import draw_light
from datagen.lights.families import EVERY, FAMILIES, PROCEDURAL, USUAL, Family, LightChoice, LightSpec
from datagen.lights.hdri import HdriSpec
from datagen.lights.light import Light
from datagen.lights.overcast import OvercastSpec
from datagen.lights.studio import Panel, StudioSpec
from datagen.lights.sun import SunSpec

__all__ = [
    "EVERY",
    "FAMILIES",
    "PROCEDURAL",
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
