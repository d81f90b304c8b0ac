"""A capture as a scene of a dataset: its surfels and its light, then its clips, and at last its record."""

from __future__ import annotations

import gc
from collections.abc import Iterable, Sequence
from dataclasses import replace

import drjit as dr

from datagen.captured_clips import made_clips, usable_rows
from datagen.captured_reconstruction import clear_work, find, kept, load, tell
from datagen.captured_relit_clips import relit_clips, require_own_truth
from datagen.captured_reuse import take_over
from datagen.captured_surfels import CapturedSurfels
from datagen.clock import stage
from datagen.plan import CAPTURE_SHARDS, RECORD_NAME, Record, Sources, Work, scene_folder
from datagen.scene_files import SceneFiles, write_clips
from datagen.settings import RELIT, Settings
from datagen.spool import Frame
from datagen.store import Store
from tron.errors import TronError
from tron.runtime import activate, set_torch_threads
from tron.shards.schema import ClipMeta
from tron.storage import write_atomic


def make_capture(item: Work, settings: Settings, sources: Sources) -> Record:  # noqa: ARG001 as all makers
    """Make one capture: surfels, light, shards, contact sheets and at last its record.

    Runs in a worker. Everything is written under final names atomically; a second run writes the same bytes.

    Raises:
        TronError: the capture cannot be read, holds too few photos in a row or too small ones, or cannot be
            reconstructed or lit.
    """
    activate(settings.variant, threads=1)
    set_torch_threads(1)
    folder = scene_folder(settings.output_dir, item.name)
    tell(item, "read")
    with stage("read"):
        capture = load(item, settings, folder, reduced=True)
        photos = load(item, settings, folder, reduced=False)
        # Minutes of reconstruction later it would be too late to say so.
        usable_rows(item, settings, photos)
        require_own_truth(item, settings, photos)
    found = kept(folder, capture)
    if found is None:
        with stage("reconstruct"):
            if not take_over(item, settings, capture, folder):
                find(item, settings, capture, folder)
        found = kept(folder, capture)
        if found is None:
            raise TronError("surfels or light cannot be read back", folder, "look for a full or failing disk")
    tell(item, "guidance")
    with stage("guidance"):
        surfels = CapturedSurfels(item, settings, found)
        with made_clips(item, settings, photos, found, surfels) as clips:
            tell(item, "write")
            made = [_written(item, settings, clips, len(clips))]
        if item.relit:
            relit = replace(item, split=f"{item.split}{RELIT}")
            made.append(_written(relit, settings, relit_clips(relit, settings, found), item.relit))
    record = Record(
        name=item.name,
        capture=item.capture,
        shards=[entry for files in made for entry in files.shards],
        quarantined=[clip for files in made for clip in files.quarantined],
        clips=[row for files in made for row in files.rows()],
    )
    write_atomic(folder / RECORD_NAME, record.model_dump_json(indent=1) + "\n")
    clear_work(folder)
    if settings.store is not None:
        with stage("upload"):
            Store(settings.store).send(settings.output_dir, record)
    del found, capture, photos, surfels
    gc.collect()
    dr.flush_malloc_cache()
    return record


def _written(
    item: Work, settings: Settings, clips: Iterable[tuple[ClipMeta, Sequence[Frame]]], most: int
) -> SceneFiles:
    """Shards of the clips of one split, at most ``most`` of them: as large as the capture's numbers ask."""
    per_shard = max(settings.clips_per_shard, -(-most // CAPTURE_SHARDS))
    return write_clips(settings.output_dir, item, clips, per_shard)
