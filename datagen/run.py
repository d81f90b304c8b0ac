"""Datasets: the scenes of the plan that are missing are made, and all of them accounted for.

Everything a worker leaves behind is whole (atomic writes) and depends on the plan alone, and a scene's record
is written last. So a run may be killed at any moment and started again: it makes the scenes that have no
record.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Sequence

import drjit as dr

from datagen.account import read_other, write_account
from datagen.build import Geometry
from datagen.captured_folder import named_by_split
from datagen.captured_reconstruction import clear_work, require_prior
from datagen.captured_reuse import require_reusable
from datagen.captured_scene import make_capture
from datagen.clock import stage
from datagen.clusters import logs_folder, require_cluster
from datagen.drawn_scene import draw_and_build
from datagen.failures import Failure, summary
from datagen.pathtrace import gbuffers
from datagen.plan import (
    RECORD_NAME,
    Record,
    Sources,
    Work,
    adopt,
    chosen,
    clear_temporaries,
    plan,
    read_record,
    scene_folder,
)
from datagen.ready_sources import ready_sources
from datagen.reconstructed import forget_reconstruction, reconstruct_surfels
from datagen.scale_settings import part_of
from datagen.scene_files import write_clips
from datagen.scheduling import make_each
from datagen.settings import Settings
from datagen.spool import Frame
from datagen.store import Store, held_bytes
from datagen.synthetic import make_clips, make_surfels
from datagen.variety import Histograms, frame_histograms, surface_members, total
from tron.cameras import Camera
from tron.runtime import activate
from tron.shards.schema import ClipMeta
from tron.storage import locked, require_free_space, write_atomic

log = logging.getLogger(__name__)


def make(settings: Settings) -> int:
    """Make what is missing of a dataset of either source; return how many scenes or clips failed.

    Raises:
        TronError: wrong settings, a folder in use, made otherwise or not writable, a store that cannot be
            written, too little space: all before the first scene; or the store is gone, whenever that is.
    """
    items = part_of(plan(settings), settings.shard)
    wanted = chosen(items, settings.only)
    require_cluster(settings)
    store = Store.of(settings)
    stored = store.shards() if store else {}
    activate(settings.variant, threads=1)
    sources = ready_sources(settings)
    other = read_other(settings.variety_against) if settings.variety_against is not None else None
    output = settings.output_dir
    if settings.source == "captured":
        if named_by_split(settings):
            log.warning(
                "captures are named by split, and the shares put them elsewhere: "
                "captured.split_by_name=true keeps test captures out of train"
            )
        require_prior(settings)
        require_reusable(settings)
    with locked(output):
        clear_temporaries(output)
        adopt(settings)
        missing = [item for item in wanted if read_record(output, item.name, stored) is None]
        for item in (item for item in wanted if item.capture and item not in missing):
            clear_work(scene_folder(output, item.name))  # killed between its record and this
        failed: dict[str, Failure] = {}
        if missing:
            require_free_space(output, held_bytes(settings, missing))
            log.info("%d of %d scenes to make in %s", len(missing), len(items), output)
            make_one = make_capture if settings.source == "captured" else make_scene
            failed = make_each(
                make_one, missing, settings, sources, lambda item: item.clips(settings), "clips"
            )
        if store:
            store.empty(output, items)
            stored = store.shards()
        failures = write_account(settings, items, sources, failed, other, stored)
        if store:
            store.finish(settings)
    if failures:
        log.error("%s", summary(failures, output, logs_folder(settings)))
    else:
        log.info("dataset is in %s: look at %s", output, output / "index.html")
    return failures


def make_scene(item: Work, settings: Settings, sources: Sources) -> Record:
    """Make one scene: specification, surfels, shards, contact sheets and at last its record.

    Runs in a worker. Everything is written under final names atomically; a second run writes the same bytes.
    """
    activate(settings.variant, threads=1)
    output = settings.output_dir
    spec, geometry = draw_and_build(item, settings, sources, settings.split(item.split).lights)
    folder = scene_folder(output, item.name)
    write_atomic(folder / "spec.json", spec.to_json())
    refinement = reconstruction = None
    if settings.surfels_from.of(settings.seed, item.split, item.index) == "reconstruction":
        surfels, reconstruction = reconstruct_surfels(spec, geometry, settings)
    else:
        surfels, refinement = make_surfels(spec, geometry, settings)
    surfels.save(folder / "surfels.ply")

    clips = make_clips(spec, geometry, surfels, settings)
    files = write_clips(output, item, clips, settings.clips_per_shard)
    record = Record(
        name=item.name,
        shards=files.shards,
        quarantined=files.quarantined,
        refinement=refinement,
        clips=files.rows(),
        variety=_variety(geometry, files.made),
        reconstruction=reconstruction,
    )
    forget_reconstruction(folder)
    write_atomic(folder / RECORD_NAME, record.model_dump_json(indent=1) + "\n")
    if settings.store is not None:
        with stage("upload"):
            Store(settings.store).send(output, record)
    del geometry, surfels
    gc.collect()
    dr.flush_malloc_cache()
    return record


def _variety(geometry: Geometry, made: Sequence[tuple[ClipMeta, Frame]]) -> Histograms:
    """Histograms of the clips' first frames: those beside them show the same."""
    cameras = [Camera.from_dict(meta.cameras[0]) for meta, _ in made]
    return total(
        frame_histograms(frame | surface_members(truth), camera, meta.extra.get("contrast_share"))
        for (meta, frame), camera, truth in zip(made, cameras, gbuffers(geometry, cameras))
    )
