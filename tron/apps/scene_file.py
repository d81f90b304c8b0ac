"""A scene's file as commands take and write it: its up, and what is guessed."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from tron.errors import TronError
from tron.gaussians.formats.registry import check_header, refuse_foreign
from tron.gaussians.scene import GaussianScene
from tron.io.recognised import refuse_by_sight

log = logging.getLogger(__name__)


def _has_a_length(up: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
    if up is not None and not 0 < math.hypot(*up) < math.inf:
        raise ValueError("a direction has a length: give three numbers that are not all 0")
    return up


Up = Annotated[
    tuple[float, float, float] | None,
    AfterValidator(_has_a_length),
    Field(
        description="up direction of the scene, such as [0,0,1]; null: the file's own, -y where it has none",
        examples=["[0,0,1]"],
    ),
]
"""Setting of a direction of any length, in the frame of the scene's file."""
SeenAs = Annotated[
    Literal["auto", "disks"],
    Field(
        description="what cameras see of a scan's splats; auto: their projections, as a splat viewer shows "
        "them; disks: flat disks in space, as light's rays meet them"
    ),
]
"""Setting of how splats are projected."""


def check_scene_files(scene: Path, output: Path, *read: Path | None) -> None:
    """What a command that makes a file of a scene needs is there, and what it writes is another file.

    Args:
        scene: that is read.
        output: that is written.
        read: other files that are read, where they are given.

    Raises:
        TronError: it is not so.
    """
    for path in (scene, *read):
        if path is not None and not path.is_file():
            if path.is_dir():
                refuse_by_sight(path, "this should be a file")
                raise TronError("cannot read: is a folder", path, "give one file of it")
            raise TronError("file not found", path)
    check_output(output, scene, "the scene")
    refuse_foreign(scene)
    check_header(scene)


def check_output(output: Path, source: Path, what: str) -> None:
    """TronError if a file to write is a folder, or ``what`` it is made of."""
    if output.is_dir():
        raise TronError("output is a folder", output, "give a file in it")
    if output.exists() and output.samefile(source):
        raise TronError(f"output is {what} itself", output, "give another name")


def load_scene(
    path: Path,
    up: Sequence[float] | None,
    materials: Literal["auto", "as_is"] = "auto",
    projection: Literal["auto", "disks"] = "auto",
) -> GaussianScene:
    """The scene of a file, with a line in the log where its materials or which way is up are guessed.

    What is up is settled by that: files that are made of the scene say so, and nobody is warned again.

    Args:
        path: the PLY.
        up: direction of any length, in the file's frame; None: the file's own.
        materials: that are guessed are not looked for (as_is).
        projection: the file's (auto), or disks in space.
    """
    scene = GaussianScene.load(path)
    if projection != "auto":
        scene.projection = projection
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
    scene.up_guessed = False
    return scene
