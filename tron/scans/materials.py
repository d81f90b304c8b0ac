"""Materials of a plain scan: found once and kept beside it, together with the proxy used to find them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tron.cameras import Camera
from tron.cli.installation import require_extra
from tron.errors import TronError
from tron.gaussians.edit import subset
from tron.gaussians.fields import MATERIALS
from tron.gaussians.kept import KeptFiles
from tron.gaussians.ply import write_ply
from tron.gaussians.scene import GaussianScene
from tron.trajectories import film_around, film_with

if TYPE_CHECKING:
    from tron.reconstruction.progress import Track

log = logging.getLogger(__name__)

VIEWS, SIDE = 64, 200


def with_materials(
    scene: GaussianScene,
    kept: KeptFiles,
    filmed: Sequence[Camera] | None,
    seed: int,
    backdrop: np.ndarray | None = None,
    turn: np.ndarray | None = None,
    track: Track = lambda items, _: items,
    find: bool = True,
) -> GaussianScene:
    """Return the scan with materials, without the light of its capture; unchanged if none can be found.

    The Mitsuba variant must be set.

    Args:
        scene: of a file without materials.
        kept: paths, for this file, of the materials and of the proxy for light that was used to find them.
        filmed: cameras that the scan was filmed with, in its world; None: around it.
        seed: root of the random numbers.
        backdrop: (M,) bool, surfels that block no light; they stay as they are.
        turn: (3, 3) rotation that was applied to the file's scene; kept files are in the file's frame.
        track: wraps long loops.
        find: whether to find materials, in minutes, if none are kept; else they stay guessed.
    """
    from tron.relighting.proxy import fingerprint  # Mitsuba: not for --help

    content = scene if backdrop is None else subset(scene, ~backdrop)
    made_from = fingerprint(content, filmed)
    path = kept.found("materials", made_from)
    found = _read(path, len(content))
    if found is None and not find:
        log.warning(
            "%s has no materials: they are guessed from its colours until they are found, in minutes: by "
            "materials=auto, or a button of tron-view",
            kept.scan,
        )
        return scene
    if found is None:
        try:
            require_extra("finding a scan's materials", "reconstruct")
        except TronError as error:
            log.warning(
                "%s: they are guessed from its colours, which keep the light it was captured in", error
            )
            return scene
        found = _found(content, kept, made_from, filmed, seed, turn, track)
        if found is None:
            return scene
    return put_on(scene, found, backdrop)


def put_on(scene: GaussianScene, found: GaussianScene, backdrop: np.ndarray | None = None) -> GaussianScene:
    """Return the scene with found materials on all surfels that are not in ``backdrop``, (M,) bool."""
    values = {name: getattr(found, name) for name in MATERIALS}
    if backdrop is not None:
        for name, own in values.items():
            values[name] = getattr(scene, name).copy()
            values[name][~backdrop] = own
    return replace(scene, **values, materials_guessed=False)


def _read(path: Path | None, count: int) -> GaussianScene | None:
    if path is None:
        return None
    try:
        scene = GaussianScene.load(path)
    except TronError:
        return None
    if len(scene) != count:
        return None
    log.info("materials are those of %s; materials=as_is leaves them out", path)
    return scene


def _found(
    scan: GaussianScene,
    kept: KeptFiles,
    made_from: str,
    filmed: Sequence[Camera] | None,
    seed: int,
    turn: np.ndarray | None,
    track: Track,
) -> GaussianScene | None:
    from tron.reconstruction.film import film_of_scan
    from tron.reconstruction.materials.carried import carry_materials
    from tron.reconstruction.materials.joint_fit import JointSettings
    from tron.relighting.proxy import fingerprint

    log.info("%s has no materials: they and the light it was captured in are looked for, once", kept.scan)
    path = kept.path("materials", made_from)
    cameras = film_with(filmed, VIEWS, SIDE) if filmed else film_around(scan, VIEWS, SIDE)
    carried = carry_materials(film_of_scan(scan, cameras, track), JointSettings(), seed, track)
    if carried is None:
        return None
    scene = carried.scene
    try:
        own = scene if turn is None or np.allclose(turn, np.eye(3)) else scene.rotated(turn.T)
        write_ply(path, vars(own) | {"normals": own.normals()}, [f"materials {made_from}"])
        proxied = fingerprint(scene, filmed)
        carried.proxy.save(kept.path("proxy", proxied), proxied)
        log.info("they are kept in %s", path)
    except TronError as error:
        log.info("materials are not kept: %s", error)
    return scene
