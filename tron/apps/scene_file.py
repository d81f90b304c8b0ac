"""A scene's file as commands take and write it: checks of it, and settings of how it is opened."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from tron.errors import TronError
from tron.io.recognised import refuse_by_sight


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
FoundMaterials = Annotated[
    Literal["auto", "as_is"],
    Field(
        description="of a scan without any; auto: found once with the light it was captured in, which is "
        "taken out of its colours, and kept as NAME.materials.ply where its proxy is; as_is: guessed from "
        "its colours"
    ),
]
"""Setting of a plain scan's materials."""
GROUND = (
    "level plane that shows the environment's ground and the shadows on it; auto: below a subject without a "
    "floor of its own; a number: at this height along up, in the scene's units"
)
SURROUNDINGS = (
    "splats far around the scene that block the light, such as a shell of sky (not walls of rooms or distant "
    "hills); drop: remove them; background: show them behind the scene, lit, without shadows, bounced light "
    "or influence on the framing; keep: treat them like all other splats"
)


def check_scene_files(scene: Path, output: Path, *read: Path | None) -> None:
    """What a command that makes a file of a scene needs is there, and what it writes is another file.

    Args:
        scene: that is read.
        output: that is written.
        read: other files that are read, where they are given.

    Raises:
        TronError: it is not so.
    """
    from tron.gaussians.formats.registry import check_header, refuse_foreign

    for path in (scene, *read):
        if path is not None:
            require_file(path)
    check_output(output, scene, "the scene")
    refuse_foreign(scene)
    check_header(scene)


def require_file(path: Path, mend: str = "") -> None:
    """TronError unless a file is there; ``mend``: what to do where nothing is."""
    if path.is_dir():
        refuse_by_sight(path, "this should be a file")
        raise TronError("cannot read: is a folder", path, "give one file of it")
    if not path.is_file():
        raise TronError("file not found", path, mend)


def check_output(output: Path, source: Path, what: str) -> None:
    """TronError if a file to write is a folder, or ``what`` it is made of."""
    if output.is_dir():
        raise TronError("output is a folder", output, "give a file in it")
    if output.exists() and output.samefile(source):
        raise TronError(f"output is {what} itself", output, "give another name")
