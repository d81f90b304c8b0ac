"""A scene's file as commands that light it take it: its up, its materials, the cameras that filmed it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from tron.apps.relight.camera_files import filmed_cameras
from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.trajectories import turn_cameras

log = logging.getLogger(__name__)


def load_scene(
    path: Path, up: Sequence[float] | None, materials: Literal["auto", "as_is"] = "auto"
) -> GaussianScene:
    """The scene of a file, with a line in the log where its materials or which way is up are guessed.

    Args:
        path: the PLY.
        up: direction of any length, in the file's frame; None: the file's own.
        materials: that are guessed are not looked for (as_is).
    """
    scene = GaussianScene.load(path)
    if scene.materials_guessed and materials == "as_is":
        log.warning(
            "%s has no materials%s: they are guessed from its colours, which keep the light that it was "
            "captured in",
            path, "" if scene.oriented else " and normals without a sign",
        )  # fmt: skip
    if up is not None:
        scene.up = np.array(up) / np.linalg.norm(up)
    elif scene.up_guessed:
        log.warning(
            "%s does not say which way is up: -y is taken, as in most 3DGS files; if the picture lies on its "
            "side, give up=[0,0,1] or another direction",
            path,
        )
    return scene


def filmed_with(path: Path, turn: np.ndarray, offset: np.ndarray) -> list[Camera] | None:
    """Cameras that a scene was filmed with, in the world turned by ``turn``; None where none lie beside."""
    try:
        filmed = filmed_cameras(path, offset)
    except TronError as error:
        log.warning("%s; the scene is filmed and orbited without it", error)
        return None
    return None if filmed is None else turn_cameras(filmed, turn)
