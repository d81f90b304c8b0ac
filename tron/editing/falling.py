"""Objects that fall, are pushed and collide: MuJoCo on the convex hulls of their surfels.

All static surfels form one height field: the highest ones below the top of the moving objects, so that tables
carry, walls stop and a ceiling is no floor. Where it is empty, objects fall out of the scene. Lengths
within are in typical radii of the bodies, whatever the scene's unit is, since contacts are tuned for those.
The same scene gives the same motion on one machine; no bits are promised across machines.
"""

# MuJoCo's compiled module has no stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import logging
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from tron.editing.motion import Fall
from tron.errors import TronError
from tron.framing import even_directions, upright
from tron.gaussians.scene import GaussianScene

log = logging.getLogger(__name__)
# Else MuJoCo writes MUJOCO_LOG.TXT into the user's folder; motion that explodes is found below.
mujoco.set_mju_user_warning(log.debug)

STEP = 0.002
"""Seconds a step."""
_CELLS = 192
_REACH = 8.0  # typical radii around the bodies that the ground is known
_DEPTH = 20.0
_MOST_STEPS = 500_000
_DEEP = 0.2  # typical radii that hulls may lie within one another, for things that lean or are hollow
_MOST_POINTS = 400  # of a hull


@dataclass(frozen=True)
class _Fallen:
    """The pose of a body: at each step where its centre is and how it has turned."""

    start: float
    about: np.ndarray
    places: np.ndarray
    turns: np.ndarray

    def at(self, seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        step = int(np.clip(round((seconds - self.start) / STEP), 0, len(self.places) - 1))
        return self.turns[step], self.about, self.places[step] - self.about


def fallen(
    scene: GaussianScene,
    bodies: list[np.ndarray],
    still: np.ndarray,
    fall: Fall,
    seconds: float,
    turn: np.ndarray,
    ground: float | None = None,
) -> list[_Fallen]:
    """Poses of the bodies, (M,) bool each, from ``fall.start`` to ``seconds``.

    ``still`` (M,) bool is what they fall on, and a plane at the height ``ground`` along up, if there is one;
    ``turn`` (3, 3) takes the world of ``fall.push`` to the scene's.

    Raises:
        TronError: a body has too few surfels for a hull, nothing stands still, or the motion explodes.
    """
    frame = upright(scene.up)  # to +z
    points = scene.means.astype(np.float64) @ frame.T
    centres = [points[body].mean(0) for body in bodies]
    solid = scene.opacity_logits > 0
    hulls = [_hull(points[body & solid] - centre) for body, centre in zip(bodies, centres)]
    unit = float(np.median([np.linalg.norm(hull, axis=1).max() for hull in hulls]))
    tops = [float(points[body][:, 2].max()) for body in bodies]
    spec = mujoco.MjSpec()
    spec.option.timestep = STEP
    spec.option.gravity = (0.0, 0.0, -fall.gravity / unit)
    spec.default.geom.friction = (fall.friction, 0.02, 0.02)
    spec.default.geom.condim = 6
    spec.default.geom.solref = (4 * STEP, 1.0)
    below = points[still & (points[:, 2] <= max(tops))]
    if ground is not None:
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(type=plane, size=(0.0, 0.0, 1.0), pos=(0.0, 0.0, ground / unit))
    stands = _add_height_field(spec, below, np.array(centres), unit, scene.spacing)
    if not stands and ground is None:
        raise TronError(
            "nothing stands below what falls", mend="leave out an object for the others to fall on"
        )
    for n, (hull, centre) in enumerate(zip(hulls, centres)):
        body = spec.worldbody.add_body(name=f"body{n}", pos=centre / unit)
        body.add_freejoint()
        mesh = spec.add_mesh(name=f"hull{n}", uservert=(hull / unit).ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"hull{n}")
    try:
        model = spec.compile()
    except ValueError as error:
        what = f"MuJoCo takes no such bodies: {' '.join(str(error).split())[:160]}"
        raise TronError(what, mend="let objects that fall be of like sizes") from error
    data = mujoco.MjData(model)
    for n, number in enumerate(fall.objects):
        push = frame @ turn @ np.array(fall.push.get(number, (0.0, 0.0, 0.0)))
        data.qvel[6 * n : 6 * n + 3] = push / unit
    _warn_of_overlaps(model, data, fall)
    steps = max(int(np.ceil((seconds - fall.start) / STEP)), 0)
    if steps > _MOST_STEPS:
        raise TronError(f"{seconds:.3g} s of falling are too many", mend="give more frames a second: fps")
    states = [np.array(data.qpos)]
    for _ in range(steps):
        mujoco.mj_step(model, data)
        states.append(np.array(data.qpos))
    path = np.array(states).reshape(len(states), len(bodies), 7)
    bad = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")
    warned = any(data.warning[getattr(mujoco.mjtWarning, name)].number for name in bad)
    if warned or not np.isfinite(path).all():
        raise TronError("the motion explodes", mend="let objects begin apart from one another and the ground")
    start = Rotation.from_quat(path[0, :, 3:], scalar_first=True)
    poses = []
    for n, centre in enumerate(centres):
        turned = Rotation.from_quat(path[:, n, 3:], scalar_first=True) * start[n].inv()
        turns = frame.T @ turned.as_matrix() @ frame
        shifts = (path[:, n, :3] - path[0, n, :3]) * unit
        poses.append(_Fallen(fall.start, frame.T @ centre, (centre + shifts) @ frame, turns))
    return poses


def _warn_of_overlaps(model: mujoco.MjModel, data: mujoco.MjData, fall: Fall) -> None:
    """Say which bodies begin within another or the ground: they are thrown apart."""
    mujoco.mj_forward(model, data)
    deep = {}
    for contact in data.contact:
        if contact.dist < -_DEEP:
            names = (int(model.geom_bodyid[geom]) - 1 for geom in contact.geom)
            deep[" and ".join("the ground" if n < 0 else f"object {fall.objects[n]}" for n in names)] = None
    if deep:
        log.warning("%s begin within one another and will be thrown apart", "; ".join(deep))


def _hull(points: np.ndarray) -> np.ndarray:
    """(V, 3) corners of the convex hull of points (N, 3)."""
    try:
        corners = points[ConvexHull(points).vertices]
    except (QhullError, ValueError) as error:
        what = "an object's surfels enclose no space"
        raise TronError(what, mend="choose objects that are solid, not single surfels or sheets") from error
    if len(corners) <= _MOST_POINTS:
        return corners
    directions = even_directions(_MOST_POINTS)
    return corners[np.unique((directions @ corners.T).argmax(1))]


def _add_height_field(
    spec: mujoco.MjSpec, points: np.ndarray, bodies: np.ndarray, unit: float, spacing: float
) -> bool:
    """Points (N, 3) of what stands still as a height field around the bodies (B, 3); False of none there."""
    if not len(points):
        return False
    low = np.maximum(points[:, :2].min(0), bodies[:, :2].min(0) - _REACH * unit)
    high = np.minimum(points[:, :2].max(0), bodies[:, :2].max(0) + _REACH * unit)
    inside = np.all((points[:, :2] >= low) & (points[:, :2] <= high), axis=1)
    if not inside.any() or not (high > low).all():
        return False
    points = points[inside]
    cell = max(float((high - low).max()) / _CELLS, 1.5 * spacing)
    shape = np.maximum(np.ceil((high - low) / cell).astype(int) + 1, 2)
    heights = np.full(shape, -np.inf)
    at = np.minimum(((points[:, :2] - low) / cell + 0.5).astype(int), shape - 1)
    np.maximum.at(heights, (at[:, 0], at[:, 1]), points[:, 2])
    bottom = float(points[:, 2].min()) - _DEPTH * unit
    closed = ndimage.grey_closing(np.where(np.isfinite(heights), heights, bottom), size=(3, 3))
    # Around it nothing: things fall off, and the lowest height is known, which MuJoCo takes for 0.
    heights = np.pad(np.where(np.isfinite(heights), heights, closed), 1, constant_values=bottom)
    rise = float(heights.max()) - bottom
    half, middle = 0.5 * cell * (shape + 1) / unit, (low + 0.5 * cell * (shape - 1)) / unit
    spec.add_hfield(
        name="ground", nrow=int(shape[1]) + 2, ncol=int(shape[0]) + 2, size=(*half, rise / unit, 1.0),
        userdata=((heights - bottom) / rise).T.ravel(),
    )  # fmt: skip
    field = mujoco.mjtGeom.mjGEOM_HFIELD
    spec.worldbody.add_geom(type=field, hfieldname="ground", pos=(*middle, bottom / unit))
    return True
