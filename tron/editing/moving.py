"""A scene in motion: where its parts stand at any time.

motion = Motion.read(Path("motion.yaml"))
moving = in_motion(motion, scene, seconds=2.0)
relighter = relighter.changed(moving.at(0.5))
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from tron.editing.motion import MeshPath, Motion, ObjectPath, between
from tron.editing.placement import foot
from tron.errors import TronError, located
from tron.gaussians.edit import moved
from tron.gaussians.scene import GaussianScene


class Pose(Protocol):
    """A rigid motion in time."""

    def at(self, seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotation (3, 3), the point that it keeps (3,), and the shift after it (3,), world."""
        ...


@dataclass(frozen=True)
class _Keyed:
    """The pose of a path."""

    times: np.ndarray
    values: np.ndarray
    axis: np.ndarray
    about: np.ndarray

    def at(self, seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        *by, turn = between(self.times, self.values, seconds)
        rotation = Rotation.from_rotvec(np.radians(turn) * self.axis).as_matrix()
        return rotation, self.about, np.array(by)


@dataclass(frozen=True)
class MovingScene:
    """A scene, and where its parts are in time.

    Attributes:
        scene: as it stands at first.
        which: (M,) int32, number of each surfel's pose; -1: it stands still.
        poses: rigid motions.
        meshes: the pose's number of each mesh that moves, by the mesh's own, from 0.
    """

    scene: GaussianScene
    which: np.ndarray
    poses: Sequence[Pose]
    meshes: Mapping[int, int] = field(default_factory=dict)
    _nearest: dict[int, np.ndarray] = field(default_factory=dict, init=False, repr=False, compare=False)

    def poses_at(self, seconds: float) -> bytes:
        """All poses of a time, to tell whether anything has moved since another."""
        return b"".join(array.tobytes() for pose in self.poses for array in pose.at(seconds))

    def at(self, seconds: float) -> GaussianScene:
        """The scene at a time; it shares with ``scene`` what does not change."""
        return self._at(self.scene, self.which, seconds)

    def meshes_at(self, seconds: float, count: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray] | None]:
        """Pose of each of ``count`` meshes at a time, from where it stands at first; None: there."""
        moving = {mesh: self.poses[pose].at(seconds) for mesh, pose in self.meshes.items()}
        return [moving.get(mesh) for mesh in range(count)]

    def follow(self, surfels: GaussianScene, seconds: float) -> GaussianScene:
        """Move other surfels of the same objects, such as a proxy: each follows the nearest of the scene."""
        if id(surfels) not in self._nearest:
            _, nearest = KDTree(self.scene.means).query(surfels.means)
            self._nearest[id(surfels)] = self.which[nearest]
        return self._at(surfels, self._nearest[id(surfels)], seconds)

    def _at(self, scene: GaussianScene, which: np.ndarray, seconds: float) -> GaussianScene:
        for number, pose in enumerate(self.poses):
            rotation, about, by = pose.at(seconds)
            still = np.allclose(rotation, np.eye(3), atol=1e-9)
            selected = which == number
            if selected.any() and not (still and not by.any()):
                scene = moved(scene, selected, None if still else rotation, by, about)
        return scene


def in_motion(
    motion: Motion,
    scene: GaussianScene,
    seconds: float,
    turn: np.ndarray | None = None,
    ground: float | None = None,
    backdrop: np.ndarray | None = None,
    feet: Sequence[np.ndarray] = (),
) -> MovingScene:
    """The scene in motion.

    Args:
        motion: of its things; its light is not looked at.
        scene: the surfels as they stand at first.
        seconds: of the last frame; what falls is simulated so far.
        turn: (3, 3) that takes the motion's world to the scene's; none by default.
        ground: height of a plane that things fall on, along the scene's up; None: there is none.
        backdrop: (M,) bool, surfels that nothing falls on.
        feet: (3,) point that each mesh stands on, in the scene's world.

    Raises:
        TronError: a selection holds nothing, or surfels that already move; what falls has no shape or no
            ground; there is no such mesh, or it already moves.
    """
    turn = np.eye(3) if turn is None else turn
    own = scene if np.allclose(turn, np.eye(3)) else scene.rotated(turn.T)
    which = np.full(len(scene), -1, np.int32)
    poses: list[Pose] = []
    for n, path in enumerate(motion.objects, 1):
        with located(f"motion, path {n} of objects"):
            if path.select.asks_views:
                raise TronError(
                    "pixels, clicks and masks select nothing in a motion",
                    mend="give what moves an object number: action: duplicate or insert of tron-edit",
                )
            selected = path.select.of(own)
            _claim(which, selected, len(poses))
            poses.append(_keyed(path, own, lambda which=selected: foot(own, which), turn))
    meshes: dict[int, int] = {}
    for n, path in enumerate(motion.meshes, 1):
        with located(f"motion, path {n} of meshes"):
            if path.mesh > len(feet):
                raise TronError(f"there is no mesh {path.mesh}", mend="give it in meshes=[...]")
            if path.mesh - 1 in meshes:
                raise TronError(f"mesh {path.mesh} moves already", mend="let each mesh move once")
            meshes[path.mesh - 1] = len(poses)
            stands = turn.T @ feet[path.mesh - 1]
            poses.append(_keyed(path, own, lambda stands=stands: stands, turn))
    if motion.fall is not None:
        from tron.editing.falling import fallen  # MuJoCo: for what falls alone

        with located("motion, fall"):
            bodies = []
            still = np.ones(len(scene), bool) if backdrop is None else ~backdrop
            still &= (which < 0) & (scene.opacity_logits > 0)  # floaters carry nothing
            for number in motion.fall.objects:
                selected = scene.object_id == number
                _claim(which, selected, len(poses) + len(bodies), f"object {number}")
                bodies.append(selected)
            still &= ~np.any(bodies, axis=0)
            poses += fallen(scene, bodies, still, motion.fall, seconds, turn, ground)
    return MovingScene(scene, which, tuple(poses), meshes)


def _claim(which: np.ndarray, selected: np.ndarray, number: int, name: str = "") -> None:
    """Note in ``which`` (M,) that surfels (M,) bool move by a pose."""
    if not selected.any():
        raise TronError(f"there is no {name}" if name else "no surfel is selected", mend="name what is there")
    if (which[selected] >= 0).any():
        raise TronError(f"{name or 'what it selects'} moves already", mend="let each surfel move once")
    which[selected] = number


def _keyed(
    path: ObjectPath | MeshPath, scene: GaussianScene, stands: Callable[[], np.ndarray], turn: np.ndarray
) -> _Keyed:
    axis = np.array(scene.up if path.axis is None else path.axis, np.float64)
    about = stands() if path.about is None else np.array(path.about)
    values = np.array([[*(turn @ np.array(key.by)), key.turn] for key in path.keys])
    times = np.array([key.time for key in path.keys])
    return _Keyed(times, values, turn @ (axis / np.linalg.norm(axis)), turn @ about)
