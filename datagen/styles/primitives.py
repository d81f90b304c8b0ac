"""Styles A and B: primitive solids at rest on a square floor, two distributions with nothing in common.

They share neither shapes nor patterns, and keep what they drew when they were all that there was, so that
what is made since can be held against them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from trimesh import Trimesh

from datagen.layout import Placement, place
from datagen.materials import draw_pattern
from datagen.materials.pattern import Palette
from datagen.objects import ObjectSpec
from datagen.paths import OscillatingPath, SpiralPath
from datagen.shapes import ShapeSpec, draw_shape, make_pieces
from datagen.styles.composition import Choice, Composition, Streams
from tron.errors import TronError

LAYOUT_EDGE = 0.5
"""Edge length of the meshes that objects are placed with: only their convex hulls matter there."""

FEWEST_OBJECTS = 2
SCENE_RADIUS = 1.45
"""World units from the origin within which objects stand: all of them in view from every camera."""

FOV_DEG = 34.0
TARGET = (0.0, 0.0, 0.3)
UNMOVED = Placement(quaternion=(1.0, 0.0, 0.0, 0.0), position=(0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Distribution:
    """Shapes, counts and sizes of a style."""

    kinds: tuple[str, ...]
    objects: tuple[int, int]
    size: tuple[float, float]
    floor: float


DISTRIBUTIONS: dict[Palette, Distribution] = {
    "A": Distribution(("sphere", "box", "cylinder", "cone", "torus", "blob"), (3, 7), (0.4, 0.85), 3.0),
    "B": Distribution(("capsule", "gem", "star", "vase", "knot", "superquadric"), (2, 4), (0.55, 1.0), 2.6),
}


def primitives(palette: Palette, streams: Streams, choice: Choice) -> Composition:
    """Draw a scene of style A or B.

    Raises:
        TronError: fewer objects found a place than make a scene.
    """
    known = DISTRIBUTIONS[palette]
    low, high = choice.objects or known.objects
    rng = streams("objects")
    drawn: list[tuple[ShapeSpec | None, str | None, float]] = []
    meshes: list[Trimesh] = []
    names = sorted(choice.assets)
    for _ in range(int(rng.integers(low, high + 1))):
        if names and rng.random() < choice.asset_share:
            name, size = names[int(rng.integers(len(names)))], round(float(rng.uniform(*known.size)), 6)
            drawn.append((None, name, size))
            meshes.append(choice.assets[name].copy().apply_scale(size))
        else:
            shape = draw_shape(rng, known.kinds, known.size)
            drawn.append((shape, None, shape.size))
            meshes.append(make_pieces(shape, LAYOUT_EDGE)[0].mesh)
    upright = [shape is None for shape, _, _ in drawn]
    places = place(streams("layout"), meshes, SCENE_RADIUS, upright=upright)
    rng = streams("materials")
    materials = [(draw_pattern(rng, palette),) if shape else () for shape, _, _ in drawn]
    placed = tuple(
        ObjectSpec(shape=shape, asset=asset, size=size, materials=material, placement=spot)
        for (shape, asset, size), material, spot in zip(drawn, materials, places)
        if spot is not None
    )
    if len(placed) < min(FEWEST_OBJECTS, len(drawn)):
        raise TronError(f"only {len(placed)} of {len(drawn)} objects found a place on the floor")
    corner = known.floor * np.sqrt(2.0)
    floor = ObjectSpec(
        shape=ShapeSpec(kind="floor", size=corner, parameters=(0.5, 0.5, 0.5, 0.5)),
        materials=(draw_pattern(streams("floor"), palette, floor=True),),
        size=corner,
        placement=UNMOVED,
    )
    rng = streams("cameras")
    start = rng.uniform(0.0, 360.0)
    capture = SpiralPath(target=TARGET, fov_deg=FOV_DEG, radius=6.4, phase_deg=rng.uniform(0.0, 360.0))
    film = OscillatingPath(
        target=TARGET,
        fov_deg=FOV_DEG,
        radius=rng.uniform(5.8, 6.6),
        elevation_deg=rng.uniform(24.0, 34.0),
        amplitude_deg=rng.uniform(8.0, 15.0),
        azimuth_deg=(start, start + 321.0),
    )
    return Composition((floor,), placed, len(drawn) - len(placed), (capture,), film)


STYLE_A = partial(primitives, "A")
STYLE_B = partial(primitives, "B")
