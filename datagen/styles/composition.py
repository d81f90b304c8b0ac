"""Composition of a scene by its style: things, and the paths that cameras take among them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from trimesh import Trimesh

from datagen.objects import ObjectSpec
from datagen.paths import PathSpec
from datagen.texture_sets import TextureSet

Streams = Callable[[str], np.random.Generator]
"""The scene's random stream of a name."""


@dataclass(frozen=True)
class Choice:
    """Wishes of a recipe for a scene's objects.

    Attributes:
        assets: id -> mesh in a unit ball, z up, standing; empty means procedural shapes only.
        asset_share: probability that an object is an asset, where there are any.
        objects: least and greatest number of objects; None takes the style's own.
        textures: texture sets; empty means procedural materials only.
        texture_share: probability that a piece has one of them, where one suits its role.
    """

    assets: Mapping[str, Trimesh] = field(default_factory=dict)
    asset_share: float = 1.0
    objects: tuple[int, int] | None = None
    textures: tuple[TextureSet, ...] = ()
    texture_share: float = 0.5


@dataclass(frozen=True)
class Composition:
    """A scene without its light.

    Attributes:
        surroundings: what stands still around the objects, such as the floor.
        objects: what stands there.
        left_out: how many more were drawn and found no place.
        capture: paths of the views that surfels are made from, each taking an equal share of them.
        film: path that clips are cut from.
        metered: frames are exposed for what they show, as a camera does indoors, not for the light outside.
    """

    surroundings: tuple[ObjectSpec, ...]
    objects: tuple[ObjectSpec, ...]
    left_out: int
    capture: tuple[PathSpec, ...]
    film: PathSpec
    metered: bool = False
