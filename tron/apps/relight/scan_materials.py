"""Materials of a plain scan for tron-relight: found once, and kept beside it as NAME.materials.ply."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tron.cameras import Camera
from tron.cli.installation import require_extra
from tron.cli.progress import track
from tron.errors import TronError
from tron.gaussians.edit import subset
from tron.gaussians.fields import MATERIALS
from tron.gaussians.ply import header_comments, write_ply
from tron.gaussians.scene import GaussianScene
from tron.trajectories import film_around, film_with

log = logging.getLogger(__name__)

VIEWS, SIDE = 64, 200


def with_materials(
    scene: GaussianScene,
    path: Path,
    filmed: Sequence[Camera] | None,
    seed: int,
    backdrop: np.ndarray | None = None,
    turn: np.ndarray | None = None,
) -> GaussianScene:
    """The scan with materials, free of the light it was captured in; as it is where none can be told.

    The Mitsuba variant must be set.

    Args:
        scene: of a file without materials.
        path: of that file, beside which they are kept, with the proxy for light that they were found on.
        filmed: cameras that the scan was filmed with, in its world; None: around it.
        seed: root of the random numbers.
        backdrop: (M,) bool, surfels that are in no light's way, which stay as they are.
        turn: (3, 3) that the file's scene was turned by; what is kept beside it stands as it does.
    """
    from tron.relighting.proxy import fingerprint  # Mitsuba: not for --help

    content = scene if backdrop is None else subset(scene, ~backdrop)
    made_from, kept = fingerprint(content, filmed), path.with_suffix(".materials.ply")
    found = _kept(kept, made_from, len(content))
    if found is not None:
        log.info("materials are those of %s; materials=as_is leaves them out", kept)
    else:
        try:
            require_extra("finding a scan's materials", "reconstruct")
        except TronError as error:
            log.warning(
                "%s: they are guessed from its colours, which keep the light it was captured in", error
            )
            return scene
        found = _found(content, path, kept, made_from, filmed, seed, turn)
        if found is None:
            return scene
    values = {name: getattr(found, name) for name in MATERIALS}
    if backdrop is not None:
        for name, own in values.items():
            values[name] = getattr(scene, name).copy()
            values[name][~backdrop] = own
    return replace(scene, **values, materials_guessed=False)


def _kept(path: Path, made_from: str, count: int) -> GaussianScene | None:
    from tron.relighting.proxy import made_as_now

    if not made_as_now(path, header_comments(path), f"materials {made_from}"):
        return None
    try:
        scene = GaussianScene.load(path)
    except TronError:
        return None
    return scene if len(scene) == count else None


def _found(
    scan: GaussianScene,
    path: Path,
    kept: Path,
    made_from: str,
    filmed: Sequence[Camera] | None,
    seed: int,
    turn: np.ndarray | None,
) -> GaussianScene | None:
    from tron.reconstruction.film import film_of_scan
    from tron.reconstruction.materials.carried import carry_materials
    from tron.reconstruction.materials.joint_fit import JointSettings
    from tron.relighting.proxy import fingerprint

    log.info("%s has no materials: they and the light it was captured in are looked for, once", path)
    cameras = film_with(filmed, VIEWS, SIDE) if filmed else film_around(scan, VIEWS, SIDE)
    carried = carry_materials(film_of_scan(scan, cameras, track), JointSettings(), seed, track)
    if carried is None:
        return None
    scene = carried.scene
    try:
        own = scene if turn is None or np.allclose(turn, np.eye(3)) else scene.rotated(turn.T)
        write_ply(kept, vars(own) | {"normals": own.normals()}, [f"materials {made_from}"])
        carried.proxy.save(path.with_suffix(".proxy.ply"), fingerprint(scene, filmed))
        log.info("they are kept in %s", kept)
    except TronError as error:
        log.info("materials are not kept: %s", error)
    return scene
