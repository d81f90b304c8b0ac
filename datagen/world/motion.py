"""Motion within a clip: an object that is lifted and turned, lights that turn about the zenith.

Time runs from 0 at a clip's first frame to 1 at its last, so clips of any length show the whole of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from datagen.world.objects import ObjectSpec
from datagen.world.spec import Number, Spec

LIFT = (0.25, 0.7)
OBJECT_TURN_DEG = 60.0
LIGHT_TURN_DEG = (15.0, 90.0)


class Share(NamedTuple):
    """Probability that an object of a scene moves, and that a light does."""

    objects: float = 0.0
    lights: float = 0.0


STILL = Share()


class Pose(NamedTuple):
    """Rigid motion from where an object rests: (3, 3) about ``pivot`` (3,), then by ``shift`` (3,), world."""

    rotation: np.ndarray
    shift: np.ndarray
    pivot: np.ndarray

    def matrix(self) -> np.ndarray:
        """(4, 4) float64, from the world where it rests to the world where it has come to."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.pivot + self.shift - self.rotation @ self.pivot
        return matrix


class MotionSpec(Spec):
    """One object that is lifted straight up and, once it is clear of the others, turned.

    Attributes:
        object: its number among the scene's objects.
        lift: how far it is at the end, world units.
        turn_deg: by how much it has turned about the vertical by then.
    """

    object: int
    lift: Number
    turn_deg: Number

    def pose(self, item: ObjectSpec, time: float) -> Pose:
        """Pose of the object at a time; at 0 it rests."""
        turn = Rotation.from_euler("z", self.turn_deg * time**3, degrees=True).as_matrix()
        shift = np.array([0.0, 0.0, self.lift * np.sin(0.5 * np.pi * time)])
        return Pose(turn, shift, np.asarray(item.placement.position, np.float64))


def draw_motion(
    rng: np.random.Generator, objects: Sequence[ObjectSpec], lights: int, share: Share
) -> tuple[MotionSpec | None, tuple[float, ...]]:
    """Draw what moves: nothing or the topmost object, which nothing lies on; and each light's turn, degrees.

    The turns are empty where no light of the scene can move.
    """
    motion = None
    if objects and rng.random() < share.objects:
        top = int(np.argmax([item.placement.position[2] for item in objects]))
        turn = rng.uniform(-OBJECT_TURN_DEG, OBJECT_TURN_DEG)
        motion = MotionSpec(object=top, lift=rng.uniform(*LIFT), turn_deg=turn)
    if not share.lights:
        return motion, ()
    turns = [
        rng.choice([-1.0, 1.0]) * rng.uniform(*LIGHT_TURN_DEG) if rng.random() < share.lights else 0.0
        for _ in range(lights)
    ]
    return motion, tuple(turns)
