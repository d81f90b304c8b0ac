"""Things at rest after they were dropped: strewn about, in a heap, or stacked.

:func:`settle` starts bodies apart from each other above the ground and lets rigid-body steps bring them to
rest. What falls off, sinks in or does not come to rest is dropped once more, a bounded number of times, and
then left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation
from shapely import MultiPoint
from trimesh import Trimesh

from datagen.world.objects import Placement
from datagen.world.rigid_bodies import MARGIN, Body, Exploded, RigidBodies
from datagen.world.shapes import Standing

__all__ = ["Arrangement", "Body", "roll_to_rest", "settle"]

Arrangement = Literal["strewn", "pile", "stack"]
"""Strewn over a disk, each on free ground; dropped onto one heap; one upon the other."""

ATTEMPTS = 3
FREE_STEPS, STEPS = 400, 1400
"""Steps of one attempt that are free of drag, and most steps of it in all."""

DRAG = 0.02
"""Share of its velocity that everything loses in a step after the free ones: balls stop rolling."""

STILL = 0.02
"""Typical bodies a second below which a body is at rest."""

STILL_STEPS = 15
RESTLESS = 0.1
"""Above it a body still moves when its time is up."""

ROOMY = 1.15
"""Least radius of a heap's bin over that of its largest body."""

FACES = 6
"""Resting poses of which the flattest is stacked."""

STAGGER = 0.03
"""Standard deviation of a stacked body's place, in its own widths."""

DEEPEST = 0.02
"""Typical bodies that one may lie deep in another: more and it has sunk in."""

TRIES = 30


def settle(
    rng: np.random.Generator,
    bodies: Sequence[Body],
    ground: Standing,
    *,
    arrangement: Arrangement = "strewn",
    centre: tuple[float, float] = (0.0, 0.0),
    radius: float = 1.0,
    fixed: Sequence[tuple[Body, Placement]] = (),
) -> list[Placement | None]:
    """Drop bodies and wait until they rest.

    Args:
        rng: source of orientations and positions.
        bodies: what is dropped, the first ones first; in a stack the first is the lowest.
        ground: what they fall on, see :func:`datagen.world.shapes.standing`.
        arrangement: how they are dropped.
        centre, radius: the disk over which they are dropped, world units; a stack stands at its centre.
        fixed: things that stand there already and do not move.

    Returns:
        One placement a body, in order, the same on every machine; None for what found no rest within
        ATTEMPTS. Upright bodies only turn about z. Hulls lie at most DEEPEST typical bodies in one another.
    """
    if not bodies:
        return []
    bin = None
    if arrangement == "pile":
        # A heap is poured into a bin without friction that is then lifted; dropped freely, things scatter.
        widest = max(float(np.linalg.norm(body.points, axis=1).max()) for body in bodies)
        radius = max(radius, ROOMY * widest)
        # The whole bin stands over the ground, away from its rim or walls.
        low, high = ground.low[:2] + radius, ground.high[:2] - radius
        x, y = np.clip(centre, np.minimum(low, high), np.maximum(low, high)).tolist()
        centre, bin = (x, y), (x, y, radius)
    world = RigidBodies(bodies, ground, fixed, bin)
    drop = _Drop(rng, ground, centre, radius, arrangement, 2.0 * MARGIN * world.unit)
    waiting = list(range(len(bodies)))
    rest: list[Placement | None] = [None] * len(bodies)
    for _ in range(ATTEMPTS):
        standing = [(bodies[i], placement) for i, placement in enumerate(rest) if placement is not None]
        for i, placement in enumerate(rest):
            if placement is None:
                world.take_away(i)
            else:
                matrix = placement.matrix()
                world.put(i, matrix[:3, :3], matrix[:3, 3])
        starts = drop.starts([bodies[i] for i in waiting], [*fixed, *standing])
        for i, (rotation, position) in zip(waiting, starts):
            world.put(i, rotation, position)
        try:
            _run(world)
        except Exploded:
            # Nothing of this attempt can be trusted; what rested before it still does.
            continue
        sunk = world.depths() > DEEPEST * world.unit
        rest = [None if deep else world.placement(i) for i, deep in enumerate(sunk)]
        waiting = [i for i, placement in enumerate(rest) if placement is None]
        if not waiting:
            break
    return rest


def _run(world: RigidBodies) -> None:
    """Step until everything has been still for STILL_STEPS; what still moves after STEPS is taken away."""
    _until_still(world, FREE_STEPS, drag=0.0)
    world.lift_bin()
    _until_still(world, STEPS - FREE_STEPS, drag=DRAG)
    for i, speed in enumerate(world.speeds()):
        if speed > RESTLESS:
            world.take_away(i)


def _until_still(world: RigidBodies, steps: int, drag: float) -> None:
    still = 0
    for _ in range(steps):
        world.step(drag)
        still = still + 1 if world.speeds().max() < STILL else 0
        if still >= STILL_STEPS:
            return


def roll_to_rest(hull: Trimesh, rotation: np.ndarray) -> np.ndarray:
    """Roll a convex body from an orientation to the stable face it comes to rest on.

    The body tips over the face under its centre of mass until that face is the one below: each roll lowers
    the centre of mass, so this ends. Returns the (3, 3) rotation at rest.
    """
    normals = np.asarray(hull.face_normals, dtype=np.float64)
    heights = ((np.asarray(hull.triangles_center) - hull.center_mass) * normals).sum(axis=1)
    down = rotation.T @ (0.0, 0.0, -1.0)
    lowest = np.inf
    while True:
        facing = normals @ down
        reach = np.where(facing > 1e-9, heights / np.maximum(facing, 1e-9), np.inf)
        face = int(reach.argmin())
        if heights[face] >= lowest - 1e-9:
            break
        lowest = float(heights[face])
        down = normals[face]
    turn = Rotation.align_vectors([[0.0, 0.0, -1.0]], [rotation @ down])[0]
    return turn.as_matrix() @ rotation


class _Drop:
    """Starts of bodies: apart from each other and from what stands there."""

    def __init__(
        self,
        rng: np.random.Generator,
        ground: Standing,
        centre: tuple[float, float],
        radius: float,
        arrangement: Arrangement,
        gap: float,
    ):
        self._rng, self._ground, self._arrangement, self._gap = rng, ground, arrangement, gap
        self._centre, self._radius = np.asarray(centre, np.float64), radius

    def starts(
        self, bodies: Sequence[Body], standing: Sequence[tuple[Body, Placement]]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """A rotation (3, 3) and a position (3,) for each body."""
        taken = [_Prism(placement.moved(hull)) for body, placement in standing for hull in body.hulls]
        started = []
        for body in bodies:
            turn = self._turn(body)
            points = body.points @ turn.T
            place = self._stacked if self._arrangement == "stack" else self._free
            position = place(points, taken)
            taken.append(_Prism(points + position))
            started.append((turn, position))
        return started

    def _turn(self, body: Body) -> np.ndarray:
        spin = Rotation.from_euler("z", self._rng.uniform(0.0, 2 * np.pi)).as_matrix()
        if body.upright:
            return spin
        drawn = [Rotation.random(rng=self._rng).as_matrix() for _ in range(FACES)]
        if self._arrangement == "pile":
            return drawn[0]
        hull = Trimesh(body.points).convex_hull
        if self._arrangement == "strewn":
            return roll_to_rest(hull, drawn[0])
        resting = [roll_to_rest(hull, turn) for turn in drawn]
        # Faces of a cube are equally high but for the last bit, which must not choose.
        heights = [round(float(np.ptp((hull.vertices @ turn.T)[:, 2])), 4) for turn in resting]
        return spin @ resting[int(np.argmin(heights))]

    def _stacked(self, points: np.ndarray, taken: Sequence[_Prism]) -> np.ndarray:
        """On top of all that stands where the stack does."""
        middle = 0.5 * (points.max(axis=0) + points.min(axis=0))[:2]
        at = self._centre - middle + self._rng.normal(0.0, STAGGER, 2) * np.ptp(points[:, :2], axis=0)
        position = self._on_ground(points, at)
        candidate = _Prism(points + position)
        tops = [other.high for other in taken if other.footprint.distance(candidate.footprint) <= self._gap]
        rise = max([0.0, *(top + self._gap - candidate.low for top in tops)])
        position[2] += rise
        return position

    def _free(self, points: np.ndarray, taken: Sequence[_Prism]) -> np.ndarray:
        """The lowest place that is free among TRIES: on the ground, or above what stands there."""
        low, high = (
            self._ground.low[:2] - points.min(axis=0)[:2],
            self._ground.high[:2] - points.max(axis=0)[:2],
        )
        inside = self._radius - float(np.linalg.norm(points[:, :2], axis=1).max())
        radius = max(inside, 0.0) if self._arrangement == "pile" else self._radius
        best = np.full(3, np.inf)
        for _ in range(TRIES):
            distance, angle = radius * np.sqrt(self._rng.random()), self._rng.uniform(0.0, 2 * np.pi)
            at = self._centre + distance * np.array([np.cos(angle), np.sin(angle)])
            position = self._on_ground(points, np.clip(at, np.minimum(low, high), np.maximum(low, high)))
            grounded = position[2]
            # Lowest first: one rise over each clears them all.
            for other in sorted(taken, key=lambda prism: prism.high):
                if not _Prism(points + position).is_apart_from([other], self._gap):
                    position[2] = other.high + 2.0 * self._gap - points[:, 2].min()
            if position[2] < best[2]:
                best = position
            if position[2] == grounded:
                break
        return best

    def _on_ground(self, points: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Position over ``at`` (2,) such that no point is below the ground, and ``gap`` above it."""
        clearance = points[:, 2] - self._ground.height(points[:, :2] + at)
        return np.array([*at, self._gap - clearance.min()])


class _Prism:
    """Footprint of points (V, 3) on the ground, and the heights between which they lie."""

    def __init__(self, points: np.ndarray):
        self.footprint = MultiPoint(points[:, :2]).convex_hull
        self.low, self.high = float(points[:, 2].min()), float(points[:, 2].max())

    def is_apart_from(self, others: Sequence[_Prism], gap: float) -> bool:
        """Whether more than ``gap`` lies between this prism and each of the others."""
        return all(
            self.low > other.high + gap
            or other.low > self.high + gap
            or self.footprint.distance(other.footprint) > gap
            for other in others
        )
