"""Things of the world with their materials, and compositions of things by styles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from trimesh import Trimesh

from datagen.world.materials import MaterialSpec, draw_material
from datagen.world.materials.photographed import Offered
from datagen.world.objects import ObjectSpec, Placement
from datagen.world.paths import PathSpec
from datagen.world.settling import Body
from datagen.world.shapes import SHAPES, ShapeSpec, Standing, draw_shape, make_pieces, standing
from tron.errors import TronError

Sizes = tuple[float, float]

COARSE_EDGE = 0.25
"""Edge length of the meshes that things come to rest with."""

VESSELS = ("bottle", "bowl", "plate", "goblet", "jar", "urn", "mug", "kettle", "vase")
HARDWARE = ("gear", "bracket", "nut", "joint", "spring", "chain", "loops", "drilled", "horn")
TOYS = ("die", "letter", "cutout", "star", "knot", "superquadric", "twisted", "gem", "capsule", "torus")
SIMPLE = ("sphere", "box", "cylinder", "cone", "blob")
PAPER = ("book", "books", "parcel", "carton")
FOUND = ("rock", "pebble", "fruit", "pumpkin", "sponge", "coral")
SOFT = ("cushion", "rumpled", "folded", "draped")
GREEN = ("plant", "branch", "grass")
SHEETS = ("card", "throw", "open_box", "screen", "foliage")
WIRE = ("grille", "basket", "cage", "lantern")
FURNITURE = ("chair", "stool", "table", "bench", "shelf", "sofa", "cabinet", "floor_lamp")
CRATES = ("crate", "carton", "basket", "stool", "desk_lamp")
STONEWORK = ("rock", "arch", "baluster", "urn", "drilled")

UNSAID = 0.1
"""Share of things of which nothing is said of metal and roughness (:class:`ObjectSpec`), where the recipe
names no materials: exporters leave it out, and scans and conversions by hand never had it."""


class Fixture(NamedTuple):
    """A fixed object, and the free space over it in the world."""

    item: ObjectSpec
    ground: Standing


@dataclass(frozen=True)
class Thing:
    """A thing without a place.

    Attributes:
        shape, materials, asset, size, unsaid: as an ObjectSpec has them.
        body: what it comes to rest with.
    """

    shape: ShapeSpec | None
    materials: tuple[MaterialSpec, ...]
    asset: str | None
    size: float
    body: Body
    unsaid: bool = False

    def at(self, placement: Placement) -> ObjectSpec:
        """Return the object at a place."""
        return ObjectSpec(
            shape=self.shape,
            materials=self.materials,
            asset=self.asset,
            size=self.size,
            unsaid=self.unsaid,
            placement=placement,
        )


def draw_thing(
    rng: np.random.Generator,
    groups: Sequence[tuple[str, ...]],
    size: Sizes,
    choice: Choice,
    *,
    large: bool = False,
) -> Thing:
    """Draw a thing: a group, a kind of it, proportions, and a material for each of its slots.

    Args:
        rng: source of all of it.
        groups: kinds to choose from, each group as likely as another.
        size: least and greatest radius, world units.
        choice: the user's models, which take the place of a share of the things; the kinds that take the
            place of the groups, and the families that materials are of.
        large: the features of its materials are as large as on a floor.
    """
    if choice.assets and rng.random() < choice.asset_share:
        names = sorted(choice.assets)
        name, radius = names[int(rng.integers(len(names)))], round(float(rng.uniform(*size)), 6)
        mesh: Trimesh = choice.assets[name].copy().apply_scale(radius)
        return Thing(None, (), name, radius, Body([mesh], upright=True))
    groups = (choice.things,) if choice.things else groups
    shape = draw_shape(rng, groups[int(rng.integers(len(groups)))], size)
    kind = SHAPES[shape.kind]
    materials = tuple(draw_material(rng, role, large=large, families=choice.materials) for role in kind.roles)
    pieces = [piece.mesh for piece in make_pieces(shape, COARSE_EDGE)]
    unsaid = not choice.materials and rng.random() < UNSAID
    return Thing(shape, materials, None, shape.size, Body(pieces, upright=kind.upright), unsaid)


def fixture(
    rng: np.random.Generator,
    kind: str,
    size: float,
    choice: Choice,
    parameters: Mapping[int, float] | None = None,
) -> Fixture:
    """Something that stands still around the things, such as a floor; what stands on it stands at z = 0.

    Args:
        rng: source of its proportions and materials.
        kind: the shape, one of those that things stand on.
        size: radius of the ball around its middle that it just fits.
        choice: the families that its materials are of.
        parameters: proportions that are not left to chance, by their number.
    """
    drawn = rng.random(4)
    for number, value in (parameters or {}).items():
        drawn[number] = value
    shape = ShapeSpec(kind=kind, size=size, parameters=tuple(drawn), seed=int(rng.integers(2**31)))
    materials = tuple(
        draw_material(rng, role, large=True, families=choice.materials) for role in SHAPES[kind].roles
    )
    ground = standing(shape)
    lift = round(-float(ground.low[2]), 6)
    placement = Placement(quaternion=(1.0, 0.0, 0.0, 0.0), position=(0.0, 0.0, lift))
    item = ObjectSpec(shape=shape, materials=materials, size=shape.size, placement=placement)
    return Fixture(item, ground.moved(np.array([0.0, 0.0, -lift]), 1.0))


def draw_things(
    rng: np.random.Generator,
    count: tuple[int, int],
    groups: Sequence[tuple[str, ...]],
    size: Sizes,
    choice: Choice,
) -> list[Thing]:
    """Draw some things, as :func:`draw_thing` does; ``count`` is their least and greatest number."""
    number = int(rng.integers(count[0], count[1] + 1))
    return [draw_thing(rng, groups, size, choice) for _ in range(number)]


def placed(
    things: Sequence[Thing], placements: Sequence[Placement | None]
) -> tuple[tuple[ObjectSpec, ...], int]:
    """Return the objects that found a place, and the number of objects that did not.

    Raises:
        TronError: none did, where there were some.
    """
    found = tuple(thing.at(spot) for thing, spot in zip(things, placements) if spot is not None)
    if things and not found:
        raise TronError(f"none of {len(things)} things came to rest")
    return found, len(things) - len(found)


def top_of(objects: Sequence[ObjectSpec]) -> float:
    """Return an approximate upper bound of the objects' height above the ground, world units."""
    return max((item.placement.position[2] + 0.6 * item.size for item in objects), default=0.0)


Streams = Callable[[str], np.random.Generator]
"""The scene's random stream of a name."""


@dataclass(frozen=True)
class Choice:
    """Settings of a recipe for a scene's objects.

    Attributes:
        assets: id -> mesh in a unit ball, z up, standing; empty means procedural shapes only.
        asset_share: probability that an object is an asset, where there are any.
        objects: least and greatest number of objects; None takes the style's own.
        things: kinds of procedural objects, each as likely as another; empty takes the style's own.
        materials: families of procedural materials; empty takes all.
        textures: texture sets; empty means procedural materials only.
        texture_share: probability that a piece has one of them, where one suits its role.
    """

    assets: Mapping[str, Trimesh] = field(default_factory=dict)
    asset_share: float = 1.0
    objects: tuple[int, int] | None = None
    things: tuple[str, ...] = ()
    materials: tuple[str, ...] = ()
    textures: tuple[Offered, ...] = ()
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
