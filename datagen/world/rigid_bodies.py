"""Rigid bodies that fall, touch and come to rest: MuJoCo on convex hulls, repeatable to the last bit.

A specification must be the same bytes on every machine, and a pile amplifies: two processors whose libraries
differ in the last bit of one sine would in time see two different piles. So the whole state that one step
hands to the next is rounded to a coarse binary grid after every step (positions and quaternions to 2^-16,
velocities to 2^-12 in units of a typical body), and nothing else is handed on: the solver starts from zero,
not from its last answer. A difference of 1e-12 is then gone after one step, unless a number happens to lie
within it of the middle between two grid points: about once in 10^7 numbers. What enters, hulls, places and
the ground, is rounded likewise. The grid also lets things come to rest: what would move by less stands still.
"""

# MuJoCo's compiled module has no stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation
from trimesh import Trimesh

from datagen.world.objects import Placement
from datagen.world.shapes import Standing

# Else MuJoCo writes MUJOCO_LOG.TXT into the user's folder; what it warns of, step() finds by itself.
mujoco.set_mju_user_warning(logging.getLogger(__name__).debug)

STEP = 0.005
"""Seconds a step."""

GRAVITY = 9.81
POSITION_GRID = 2.0**-16
VELOCITY_GRID = 2.0**-12
HULL_GRID = 2.0**-12
MARGIN = 0.003
"""Distance in typical bodies that a hull keeps from others: no surfel of one lies within another."""

FRICTION = (1.0, 0.05, 0.05)
"""Sliding (a ratio), torsional and rolling (lengths in typical bodies): of rough things that heap up."""

CELL = 0.7
"""Greatest side of a cell of terrain, in typical bodies."""

BIN_SIDES = 8

FASTEST = 30.0
"""Typical bodies a second: nothing that only fell is faster; what is was thrown by a solver gone wrong."""

FAR_BELOW = -3.0
"""Height under the ground, in typical bodies, at which something has fallen off for good."""

SUPPORTS = 256
"""Directions in which a hull keeps its outermost point."""

_PARKED = (0.0, 0.0, -1000.0)


class Exploded(Exception):
    """Motion that no fall explains: not finite, or faster than FASTEST."""


@dataclass(frozen=True)
class Body:
    """A thing that falls.

    Attributes:
        pieces: meshes in the object's frame; the convex hull of each collides. A flat one is a thin board.
        upright: it turns about z only and never tips over.
    """

    pieces: Sequence[Trimesh]
    upright: bool = False

    @cached_property
    def hulls(self) -> list[np.ndarray]:
        """(V, 3) vertices of the convex hull of each piece, at most a few hundred of them, on a grid."""
        radius = max(float(np.linalg.norm(piece.vertices, axis=1).max()) for piece in self.pieces)
        grid = HULL_GRID * 2.0 ** float(np.round(np.log2(radius)))
        hulls = []
        for piece in self.pieces:
            # Rounded first: which of two equally far points a hull keeps must not hang on a last bit.
            vertices = np.asarray(
                piece.vertices if _is_flat(piece.vertices, grid) else piece.convex_hull.vertices
            )
            points = _thick(np.unique(np.round(vertices / grid), axis=0) * grid, grid)
            hulls.append(np.asarray(_support_hull(Trimesh(points).convex_hull).vertices))
        return hulls

    @cached_property
    def points(self) -> np.ndarray:
        """(V, 3) vertices of all hulls."""
        return np.concatenate(self.hulls)


class RigidBodies:
    """Bodies over a ground, and things that stand fixed.

    Lengths within are in ``unit``, the power of two nearest to a typical radius: scaling by it loses no bit,
    and steps, margins and grids suit crumbs and wardrobes alike. Methods take and give world units.

    Args:
        bodies: what moves.
        ground: what it falls on: a flat rectangle whose rim things fall off, a room with walls, or terrain.
        fixed: bodies that stand still, with their places.
        bin: x, y and radius of walls of a bin that keeps a heap together until :meth:`lift_bin`.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        ground: Standing,
        fixed: Sequence[tuple[Body, Placement]] = (),
        bin: tuple[float, float, float] | None = None,
    ):
        self.unit = 2.0 ** float(
            np.round(np.log2(np.median([np.linalg.norm(body.points, axis=1).max() for body in bodies])))
        )
        self._bodies = bodies
        self._floor = float(ground.low[2]) / self.unit
        spec = mujoco.MjSpec()
        spec.option.timestep = STEP
        spec.option.gravity = (0.0, 0.0, -GRAVITY)
        spec.option.disableflags = (
            mujoco.mjtDisableBit.mjDSBL_WARMSTART | mujoco.mjtDisableBit.mjDSBL_AUTORESET
        )
        spec.default.geom.friction = FRICTION
        spec.default.geom.condim = 6
        spec.default.geom.solref = (2.5 * STEP, 1.0)
        spec.default.geom.margin = MARGIN
        self._add_ground(spec, ground)
        self._has_bin = bin is not None
        if bin is not None:
            self._add_bin(spec, *(round(number / self.unit / HULL_GRID) * HULL_GRID for number in bin))
        for i, (body, placement) in enumerate(fixed):
            for j, hull in enumerate(body.hulls):
                self._add_hull(spec, spec.worldbody, f"fixed{i}-{j}", placement.moved(hull))
        for i, body in enumerate(bodies):
            moving = spec.worldbody.add_body(name=f"body{i}")
            if body.upright:
                for axis in np.eye(3):
                    moving.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
                moving.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0.0, 0.0, 1.0))
            else:
                moving.add_freejoint()
            for j, hull in enumerate(body.hulls):
                self._add_hull(spec, moving, f"body{i}-{j}", hull)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        sizes = [(4, 4) if body.upright else (7, 6) for body in bodies]
        ends = np.cumsum([(0, 0), *sizes], axis=0)
        self._at = [slice(int(a[0]), int(b[0])) for a, b in pairwise(ends)]
        self._moving = [slice(int(a[1]), int(b[1])) for a, b in pairwise(ends)]
        self.gone = [False] * len(bodies)
        for i in range(len(bodies)):
            self.take_away(i)

    def put(self, i: int, rotation: np.ndarray, position: np.ndarray) -> None:
        """Place body ``i`` at rest: rotation (3, 3), of which an upright body takes the turn about z."""
        self.gone[i] = False
        if self._bodies[i].upright:
            turn: tuple[float, ...] = (float(np.arctan2(rotation[1, 0], rotation[0, 0])),)
        else:
            x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
            turn = (w, x, y, z)
        self._data.qpos[self._at[i]] = (*np.asarray(position, np.float64) / self.unit, *turn)
        self._data.qvel[self._moving[i]] = 0.0
        self._snap()

    def take_away(self, i: int) -> None:
        """Body ``i`` is no longer there."""
        self.put(i, np.eye(3), np.array(_PARKED) * self.unit * (1.0 + i))
        self.gone[i] = True

    def lift_bin(self) -> None:
        """Take the walls of the bin away, if there is one."""
        for i in range(BIN_SIDES if self._has_bin else 0):
            geom = self._model.geom(f"bin{i}")
            geom.contype = geom.conaffinity = 0

    def step(self, drag: float = 0.0) -> None:
        """Advance by STEP seconds. What has fallen far below the ground is gone.

        Args:
            drag: share of its velocity that everything loses.

        Raises:
            Exploded: the motion is not that of falling bodies.
        """
        mujoco.mj_step(self._model, self._data)
        self._data.qvel *= 1.0 - drag
        self._snap()
        if not np.isfinite(self._data.qpos).all() or not self.speeds().max() < FASTEST:
            raise Exploded
        for i in range(len(self._bodies)):
            if self.gone[i] or self._height(i) < self._floor + FAR_BELOW:
                self.take_away(i)

    def speeds(self) -> np.ndarray:
        """(B,) greatest rate of each body, in typical bodies or radians a second; 0 for what is gone."""
        rates = [float(np.abs(self._data.qvel[at]).max()) for at in self._moving]
        return np.where(self.gone, 0.0, rates)

    def energy(self) -> float:
        """Kinetic plus potential energy of all bodies, in its own units; density is MuJoCo's 1000."""
        mujoco.mj_forward(self._model, self._data)
        mujoco.mj_energyPos(self._model, self._data)
        mujoco.mj_energyVel(self._model, self._data)
        return float(self._data.energy.sum())

    def depths(self) -> np.ndarray:
        """(B,) how deep each body lies in another or in the ground, world units; 0 where it does not."""
        mujoco.mj_forward(self._model, self._data)
        depth = np.zeros(len(self._bodies))
        for contact in self._data.contact:
            for geom in contact.geom:
                body = int(self._model.geom_bodyid[geom]) - 1
                if body >= 0:
                    depth[body] = max(depth[body], -contact.dist)
        return depth * self.unit

    def placement(self, i: int) -> Placement | None:
        """Placement of body ``i``; None if it is gone."""
        if self.gone[i]:
            return None
        state = self._data.qpos[self._at[i]]
        position = state[:3] * self.unit
        if self._bodies[i].upright:
            half = 0.5 * float(state[3])
            quaternion = (float(np.cos(half)), 0.0, 0.0, float(np.sin(half)))
        else:
            w, x, y, z = (state[3:] / np.linalg.norm(state[3:])).tolist()
            quaternion = with_one_sign((w, x, y, z))
        return Placement(quaternion=quaternion, position=tuple(position))

    def _height(self, i: int) -> float:
        return float(self._data.qpos[self._at[i].start + 2])

    def _snap(self) -> None:
        self._data.qpos[:] = np.round(self._data.qpos / POSITION_GRID) * POSITION_GRID
        self._data.qvel[:] = np.round(self._data.qvel / VELOCITY_GRID) * VELOCITY_GRID

    def _add_hull(self, spec: mujoco.MjSpec, parent: mujoco.MjsBody, name: str, hull: np.ndarray) -> None:
        points = np.unique(np.round(hull / self.unit / HULL_GRID), axis=0) * HULL_GRID
        mesh = spec.add_mesh(name=name, uservert=_thick(points, HULL_GRID).ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        parent.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)

    def _add_bin(self, spec: mujoco.MjSpec, x: float, y: float, radius: float) -> None:
        half = (1.0, 2.0 * radius, 100.0)
        for i in range(BIN_SIDES):
            angle = 2 * np.pi * i / BIN_SIDES
            reach = radius + half[0]
            spec.worldbody.add_geom(
                name=f"bin{i}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=half,
                pos=(x + reach * np.cos(angle), y + reach * np.sin(angle), self._floor),
                quat=(np.cos(0.5 * angle), 0.0, 0.0, np.sin(0.5 * angle)),
                friction=(0.0, 0.0, 0.0),
            )

    def _add_ground(self, spec: mujoco.MjSpec, ground: Standing) -> None:
        low, high = np.round(np.stack([ground.low, ground.high]) / self.unit / HULL_GRID) * HULL_GRID
        middle, half = 0.5 * (low + high)[:2], 0.5 * (high - low)[:2]
        if ground.heights is not None and np.ptp(ground.heights) > 0.0:
            # A cell much smaller than a body adds contacts by the dozen and no support.
            cell = 2.0 * float(half[0]) / (len(ground.heights) - 1)
            stride = max(1, int(CELL / cell))
            while (len(ground.heights) - 1) % stride or (ground.heights.shape[1] - 1) % stride:
                stride -= 1
            coarse = ground.heights[::stride, ::stride]
            heights = np.round(coarse / self.unit / HULL_GRID) * HULL_GRID
            base, rise = float(heights.min()), float(np.ptp(heights))
            n, m = heights.shape
            spec.add_hfield(
                name="ground",
                nrow=m,
                ncol=n,
                size=(*half, rise, 1.0),
                userdata=((heights - base) / rise).T.ravel(),
            )
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", pos=(*middle, base)
            )
            return
        box = mujoco.mjtGeom.mjGEOM_BOX
        spec.worldbody.add_geom(type=box, size=(*half, 0.5), pos=(*middle, low[2] - 0.5))
        if np.isfinite(high[2]):
            for axis in (0, 1):
                for sign in (-1.0, 1.0):
                    size, place = np.array([*half, 50.0]), np.array([*middle, low[2]])
                    size[axis] = 1.0
                    place[axis] += sign * (half[axis] + 1.0)
                    spec.worldbody.add_geom(type=box, size=size, pos=place)


def _support_hull(hull: Trimesh) -> Trimesh:
    """Hull of the outermost points in SUPPORTS directions.

    It is exact for boxes and within 0.0075 for balls of size 1. A contact takes time in proportion to the
    faces, and curved bodies have thousands.
    """
    k = np.arange(SUPPORTS) + 0.5
    z, angle = 1.0 - 2.0 * k / SUPPORTS, k * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    vertices = np.asarray(hull.vertices)
    chosen = np.unique((directions @ vertices.T).argmax(axis=1))
    return Trimesh(vertices[chosen]).convex_hull if len(chosen) >= 4 else hull


def with_one_sign(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Of two quaternions that are one turn, that whose first component beyond a rounding is positive.

    Of half a turn w is a rounding to either side of 0, another one on each processor, and decides nothing.
    """
    w, x, y, z = quaternion
    rounding = 1e-3 * max(abs(part) for part in quaternion)
    if next(part for part in quaternion if abs(part) > rounding) > 0:
        return w, x, y, z
    return -w, -x, -y, -z


def _is_flat(points: np.ndarray, grid: float) -> bool:
    """Whether points (N, 3) lie within two grid steps of a plane."""
    centred = points - np.mean(points, axis=0)
    return bool(np.ptp(centred @ np.linalg.eigh(centred.T @ centred)[1][:, 0]) < 2.0 * grid)


def _thick(points: np.ndarray, grid: float) -> np.ndarray:
    """The points; flat ones, whose hull would enclose nothing, two grid steps to all sides of themselves."""
    if not _is_flat(points, grid):
        return points
    steps = 2.0 * grid * np.concatenate([np.eye(3), -np.eye(3)])
    return (points[:, None] + steps).reshape(-1, 3)
