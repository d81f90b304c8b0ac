"""Datasets: the scenes of the plan that are missing are made, and all of them accounted for.

Everything a worker leaves behind is whole (atomic writes) and depends on the plan alone, and a scene's record
is written last. So a run may be killed at any moment and started again: it makes the scenes that have no
record.
"""

from __future__ import annotations

import gc
import io
import logging
from collections.abc import Sequence
from pathlib import Path

import drjit as dr
import numpy as np

from datagen.account import read_other, write_account
from datagen.build import Geometry
from datagen.clip_preview import thumbnail_name, write_preview
from datagen.clip_rows import ClipRow, clip_row
from datagen.clock import stage
from datagen.clusters import logs_folder, require_cluster
from datagen.drawn_scene import draw_and_build
from datagen.failures import Failure, summary
from datagen.pathtrace import gbuffers
from datagen.plan import (
    RECORD_NAME,
    Quarantined,
    Record,
    Sources,
    Work,
    adopt,
    chosen,
    clear_temporaries,
    estimate_bytes,
    find_sources,
    plan,
    read_record,
    scene_folder,
)
from datagen.preview import contact_row, sheet_name, write_sheet
from datagen.reconstructed import forget_reconstruction, reconstruct_surfels
from datagen.scheduling import make_each
from datagen.settings import Settings
from datagen.synthetic import Frame, first_bad_value, make_clips, make_surfels
from datagen.variety import COUNTED_MEMBERS, Histograms, frame_histograms, surface_members, total
from tron.cameras import Camera
from tron.runtime import activate
from tron.shards.manifest import ShardEntry
from tron.shards.schema import ClipMeta
from tron.shards.writer import ShardWriter
from tron.storage import locked, require_free_space, write_atomic

log = logging.getLogger(__name__)


def make(settings: Settings) -> int:
    """Make what is missing of a dataset; return how many scenes or clips failed.

    Raises:
        TronError: wrong settings, a folder in use, made otherwise or not writable, too little space: all
            before the first scene.
    """
    items = plan(settings)
    wanted = chosen(items, settings.only)
    require_cluster(settings)
    activate(settings.variant, threads=1)
    sources = find_sources(settings)
    other = read_other(settings.variety_against) if settings.variety_against is not None else None
    output = settings.output_dir
    with locked(output):
        clear_temporaries(output)
        adopt(settings)
        missing = [item for item in wanted if read_record(output, item.name) is None]
        failed: dict[str, Failure] = {}
        if missing:
            require_free_space(output, estimate_bytes(settings, missing))
            log.info("%d of %d scenes to make in %s", len(missing), len(items), output)
            clips = {item: len(settings.split(item.split).lights) for item in missing}
            failed = make_each(make_scene, missing, settings, sources, clips.__getitem__, "clips")
        failures = write_account(settings, items, sources, failed, other)
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

    quarantined: list[Quarantined] = []
    rows: dict[str, np.ndarray] = {}
    made: list[tuple[ClipMeta, Frame]] = []
    with ShardWriter(output, item.split, settings.clips_per_shard, item.first_shard) as writer:
        for meta, frames in make_clips(spec, geometry, surfels, settings):
            problem = first_bad_value(frames)
            if problem is not None:
                quarantined.append(Quarantined(key=meta.key, reason=problem))
                _set_aside(output / "quarantine" / f"{meta.key}.npz", frames)
                continue
            with stage("write"):
                writer.write(meta, frames)
                write_preview(output, meta, frames)
                rows[meta.key] = contact_row(meta, frames[0])
            made.append((meta, {name: frames[0][name] for name in COUNTED_MEMBERS if name in frames[0]}))
    for entry in writer.entries:
        write_sheet(output / sheet_name(entry.name), [rows[key] for key in entry.keys])
    record = Record(
        name=item.name,
        shards=writer.entries,
        quarantined=quarantined,
        refinement=refinement,
        reconstruction=reconstruction,
        clips=_clip_rows([meta for meta, _ in made], writer.entries),
        variety=_variety(geometry, made),
    )
    forget_reconstruction(folder)
    write_atomic(folder / RECORD_NAME, record.model_dump_json(indent=1) + "\n")
    del geometry, surfels
    gc.collect()
    dr.flush_malloc_cache()
    return record


def _clip_rows(metas: Sequence[ClipMeta], entries: Sequence[ShardEntry]) -> list[ClipRow]:
    shards = {key: entry.name for entry in entries for key in entry.keys}
    return [clip_row(meta, shards[meta.key], thumbnail_name(meta.key)) for meta in metas]


def _variety(geometry: Geometry, made: Sequence[tuple[ClipMeta, Frame]]) -> Histograms:
    """Histograms of the clips' first frames: those beside them show the same."""
    cameras = [Camera.from_dict(meta.cameras[0]) for meta, _ in made]
    return total(
        frame_histograms(frame | surface_members(truth), camera, meta.extra.get("contrast_share"))
        for (meta, frame), camera, truth in zip(made, cameras, gbuffers(geometry, cameras))
    )


def _set_aside(path: Path, frames: Sequence[dict[str, np.ndarray]]) -> None:
    buffer = io.BytesIO()
    arrays = {member: np.stack([frame[member] for frame in frames]) for member in frames[0]}
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_atomic(path, buffer.getvalue())
