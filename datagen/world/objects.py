"""Objects of a scene as data: what each is, of what, and where it stands."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from datagen.world.materials import MaterialSpec
from datagen.world.shapes import ShapeSpec
from datagen.world.spec import Number, Spec, Triple


class Placement(Spec):
    """A rigid motion from an object's frame to the world.

    Attributes:
        quaternion: (w, x, y, z), of any length but zero.
        position: (3,) world, where the object's origin goes.
    """

    quaternion: tuple[Number, Number, Number, Number]
    position: Triple

    def matrix(self) -> np.ndarray:
        """(4, 4) float64 object-to-world."""
        matrix = np.eye(4)
        w, x, y, z = self.quaternion
        matrix[:3, :3] = Rotation.from_quat((x, y, z, w)).as_matrix()
        matrix[:3, 3] = self.position
        return matrix

    def moved(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) world points from the object's (N, 3)."""
        matrix = self.matrix()
        return points @ matrix[:3, :3].T + matrix[:3, 3]


class ObjectSpec(Spec):
    """One object: a procedural shape with a material for each slot, or an asset scaled to a ball of ``size``.

    Attributes:
        shape, materials: the shape and what its slots are made of.
        asset: id of a user's model, where there is no shape.
        size: radius in world units of the ball around its origin that it just fits.
        unsaid: its materials' metallic and roughness are 1 whatever they look like, which is what glTF means
            by a file that names neither (2.0, 3.9.2).
        placement: from its frame to the world.
    """

    shape: ShapeSpec | None = None
    materials: tuple[MaterialSpec, ...] = ()
    asset: str | None = None
    size: Number
    unsaid: bool = False
    placement: Placement
