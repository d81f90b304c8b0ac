"""Materials of a plain scan for tron-relight, found once, and where they and its proxy for light are kept."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tron.apps.relight.camera_files import filmed_with
from tron.cameras import Camera
from tron.cli.installation import require_extra
from tron.cli.progress import track
from tron.errors import TronError
from tron.framing import upright
from tron.gaussians.edit import subset
from tron.gaussians.fields import MATERIALS
from tron.gaussians.kept import KeptFiles
from tron.gaussians.ply import write_ply
from tron.gaussians.scene import GaussianScene
from tron.runtime import activate
from tron.trajectories import film_around, film_with

log = logging.getLogger(__name__)

VIEWS, SIDE = 64, 200


def with_materials(
    scene: GaussianScene,
    kept: KeptFiles,
    filmed: Sequence[Camera] | None,
    seed: int,
    backdrop: np.ndarray | None = None,
    turn: np.ndarray | None = None,
) -> GaussianScene:
    """The scan with materials, free of the light it was captured in; as it is where none can be told.

    The Mitsuba variant must be set.

    Args:
        scene: of a file without materials.
        kept: of that file: where they are kept, with the proxy for light that they were found on.
        filmed: cameras that the scan was filmed with, in its world; None: around it.
        seed: root of the random numbers.
        backdrop: (M,) bool, surfels that are in no light's way, which stay as they are.
        turn: (3, 3) that the file's scene was turned by; what is kept beside it stands as it does.
    """
    from tron.relighting.proxy import fingerprint  # Mitsuba: not for --help

    content = scene if backdrop is None else subset(scene, ~backdrop)
    made_from = fingerprint(content, filmed)
    path = kept.found("materials", made_from)
    found = _read(path, len(content), "; materials=as_is leaves them out")
    if found is None:
        try:
            require_extra("finding a scan's materials", "reconstruct")
        except TronError as error:
            log.warning(
                "%s: they are guessed from its colours, which keep the light it was captured in", error
            )
            return scene
        found = _found(content, kept, made_from, filmed, seed, turn)
        if found is None:
            return scene
    return _with(scene, found, backdrop)


def with_known_materials(scene: GaussianScene, kept: KeptFiles) -> GaussianScene:
    """The scan with the materials that :func:`with_materials` found before; as it is where it found none.

    Sets the Mitsuba variant where there are some.

    Args:
        scene: of a file without materials, in its frame.
        kept: of that file: where they would be kept.
    """
    if not any(path.is_file() for path in kept.candidates("materials")):
        return scene
    import mitsuba as mi

    from tron.relighting.proxy import fingerprint
    from tron.tracing.surroundings import find_surroundings

    if mi.variant() is None:
        activate()
    standing = scene.upright()

    def known(content: GaussianScene) -> GaussianScene | None:
        filmed = filmed_with(kept.scan, upright(scene.up), scene.offset, content)
        return _read(kept.known("materials", fingerprint(content, filmed)), len(content))

    found, around = known(standing), None
    if found is None:  # of a scan with a sky they are those of all else, but with surroundings=keep
        around = find_surroundings(standing)
        found = known(subset(standing, ~around)) if around.any() else None
    return scene if found is None else _with(scene, found, around)


def proxy_file(
    scene: GaussianScene,
    kept: KeptFiles,
    filmed: Sequence[Camera] | None,
    backdrop: np.ndarray | None = None,
) -> Path:
    """The file that has the scene's proxy, or is to have it; arguments as of :func:`with_materials`."""
    from tron.relighting.proxy import fingerprint

    content = scene if backdrop is None else subset(scene, ~backdrop)
    return kept.path("proxy", fingerprint(content, filmed))


def _with(scene: GaussianScene, found: GaussianScene, backdrop: np.ndarray | None = None) -> GaussianScene:
    """The scene with the materials that were found of what is no backdrop, (M,) bool."""
    values = {name: getattr(found, name) for name in MATERIALS}
    if backdrop is not None:
        for name, own in values.items():
            values[name] = getattr(scene, name).copy()
            values[name][~backdrop] = own
    return replace(scene, **values, materials_guessed=False)


def _read(path: Path | None, count: int, said: str = "") -> GaussianScene | None:
    if path is None:
        return None
    try:
        scene = GaussianScene.load(path)
    except TronError:
        return None
    if len(scene) != count:
        return None
    log.info("materials are those of %s%s", path, said)
    return scene


def _found(
    scan: GaussianScene,
    kept: KeptFiles,
    made_from: str,
    filmed: Sequence[Camera] | None,
    seed: int,
    turn: np.ndarray | None,
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
