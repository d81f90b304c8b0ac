"""The light of a capture: a map beside its scene, in the world of the file, as tron-reconstruct writes it."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tron.shading.environments.environment import EnvironmentMap

log = logging.getLogger(__name__)

LIGHT = "environment.exr"


def is_of_capture(file: Path, scene: Path) -> bool:
    """Whether a map is the one beside the scene's file."""
    return file.resolve() == scene.with_name(LIGHT).resolve()


def over_scene(environment: EnvironmentMap, file: Path, scene: Path, turn: np.ndarray) -> EnvironmentMap:
    """The map as it stands over the scene that ``turn`` (3, 3) has set upright: a capture's turns with it.

    Any other map has +z up and stays.
    """
    if not is_of_capture(file, scene) or np.allclose(turn, np.eye(3), atol=1e-6):
        return environment
    log.info("%s is of the scene's world and is turned upright with it", file)
    return environment.turned(turn)
