"""Objects of a scene as data: what each is, of what, and where it stands."""

from __future__ import annotations

from datagen.layout import Placement
from datagen.materials import MaterialSpec
from datagen.shapes import ShapeSpec
from datagen.spec import Number, Spec


class ObjectSpec(Spec):
    """One object: a procedural shape with a material for each slot, or an asset scaled to a ball of ``size``.

    Attributes:
        shape, materials: the shape and what its slots are made of.
        asset: id of a user's model, where there is no shape.
        size: radius in world units of the ball around its origin that it just fits.
        placement: from its frame to the world.
    """

    shape: ShapeSpec | None = None
    materials: tuple[MaterialSpec, ...] = ()
    asset: str | None = None
    size: Number
    placement: Placement
