"""Make missing captures of a dataset's scenes, and account for all of them.

Beside the folders of its camera a capture has its held-out views under other lights
(``datagen.photographs.camera_model``), which are written first. It is finished when all of them are there.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import drjit as dr

from datagen.dataset.records import CONFIG_NAME, Work
from datagen.files.sources import Sources, ready_sources
from datagen.photographs.camera_model import (
    CAPTURES,
    RELIT,
    CameraModel,
    Stage,
    relit_cameras,
    relit_folders,
    view_names,
    write_relit,
)
from datagen.photographs.manifest import CaptureManifest
from datagen.photographs.perfect import PerfectCamera
from datagen.photographs.pseudo_captures import PhoneCamera
from datagen.run.account import record_failures, summary
from datagen.run.clusters import logs_folder, require_cluster
from datagen.run.plan import chosen
from datagen.run.scheduling import make_each
from datagen.settings.command import SPLITS, Settings
from datagen.truth.build import draw_and_build
from datagen.world.scene import scene_name
from tron.captures.folder import read_capture_folder
from tron.errors import TronError
from tron.run_folder import RunFolder
from tron.runtime import activate
from tron.storage import locked, require_free_space

log = logging.getLogger(__name__)

CAMERAS: dict[str, CameraModel] = {"captures": PerfectCamera(), "pseudo_captures": PhoneCamera()}
"""Every camera model, by the mode that takes it."""


def make_captures(settings: Settings) -> int:
    """Make the missing captures of a mode in CAMERAS; return the number of failures.

    Raises:
        TronError: wrong settings, a folder in use, made otherwise or not writable, too little space: all
            before the first scene.
    """
    camera = CAMERAS[settings.mode]
    called, unit = camera.called
    items = [
        Work(split, i, scene_name(split, i), first_shard=0)
        for split, count in camera.scenes(settings).items()
        for i in range(count)
    ]
    if not items:
        raise TronError("the dataset would have no scenes", "give a split scenes, e.g. train.scenes=16")
    wanted = chosen(items, settings.only)
    require_cluster(settings)
    activate(settings.variant, threads=1)
    sources = ready_sources(settings)
    folders = [settings.output_dir / name for name in camera.folders]
    home = folders[-1]
    with locked(settings.output_dir):
        run = captures_folder(home)
        if run.recipe() is None:
            for folder in folders[:-1]:
                captures_folder(folder).require_empty()
        run.claim(camera.recipe(settings), may_grow=SPLITS)
        manifests = {folder: CaptureManifest.load(folder) for folder in folders}
        missing = [item for item in wanted if not _finished(item, settings, manifests)]
        require_free_space(folders[0], sum(camera.bytes(item, settings) for item in missing))
        failed = make_each(
            make_capture, missing, settings, sources, lambda item: camera.views(item, settings), unit
        )
        finished = [item.name for item in wanted if item.name not in failed]
        made = {item.name for item in missing}
        for folder, manifest in manifests.items():
            for name in finished:
                if name in made or name not in manifest.captures:  # made now, or copied from elsewhere
                    manifest.record(folder / name)
            manifest.save(folder)
        _record_relit(settings.output_dir / RELIT, finished, camera.settings(settings).relights)
        failures = record_failures(home, settings, wanted, failed, dict.fromkeys(finished, ()))
    log.info("%d of %d %s are in %s", len(finished), len(wanted), called, folders[0])
    if failures:
        log.error("%s", summary(failures, home, logs_folder(settings)))
    return failures


def captures_folder(folder: Path) -> RunFolder:
    """Return the folder of captures, which has captures of one recipe only."""
    return RunFolder(folder, "captures", CONFIG_NAME)


def make_capture(item: Work, settings: Settings, sources: Sources) -> Path:
    """Draw and light a scene, photograph it by the mode's camera, and return the capture's folder.

    Runs in a worker; a second run writes the same bytes.

    Raises:
        TronError: a frame is not finite, or a folder cannot be written.
    """
    activate(settings.variant, threads=1)
    camera = CAMERAS[settings.mode]
    wanted, names = camera.settings(settings), view_names(camera.views(item, settings))
    family = wanted.lights[item.index % len(wanted.lights)]
    spec, geometry = draw_and_build(item, settings, sources, [family, *wanted.relights])
    environment, *others = (
        light.bake(settings.environment_height, settings.environments).baked() for light in spec.lights
    )
    cameras = dict(zip(names, spec.views(len(names), wanted.width, wanted.height)))
    write_relit(
        settings.output_dir / RELIT, spec, geometry, others, relit_cameras(spec, cameras, wanted), wanted
    )
    camera.shoot(Stage(spec, geometry, environment, cameras), settings)
    del geometry
    gc.collect()
    dr.flush_malloc_cache()
    return settings.output_dir / CAPTURES / item.name


def _finished(item: Work, settings: Settings, manifests: Mapping[Path, CaptureManifest]) -> bool:
    """Whether a capture's folders exist, are readable, and match the manifest if they are in it."""
    if any(
        item.name in manifest.captures and not manifest.holds(folder / item.name)
        for folder, manifest in manifests.items()
    ):
        return False
    camera = CAMERAS[settings.mode]
    try:
        camera.require_whole(item.name, settings)
        relights = camera.settings(settings).relights
        relit = relit_folders(settings.output_dir / RELIT, item.name, relights)
        older = [path for path in relit if not _has_irradiance(path)]
    except TronError:
        return False
    if older:
        log.warning("%s: relit views lack irradiance, which older versions left out: made anew", item.name)
    return not older


def _has_irradiance(relit: Path) -> bool:
    """Whether all relit views of a folder have irradiance maps; TronError if it cannot be read."""
    return all(view.has("irradiance") for view in read_capture_folder(relit).views)


def _record_relit(folder: Path, names: Sequence[str], families: Sequence[str]) -> None:
    """Record the files of the relit views of some scenes, if there are lights."""
    if not families:
        return
    manifest = CaptureManifest.load(folder)
    for name in names:
        for path in relit_folders(folder, name, families):
            manifest.record(path)
    manifest.save(folder)
