"""Make missing scenes of a dataset's plan, and account for all of them.

Everything a worker leaves behind is whole (atomic writes) and depends on the plan alone, and a scene's record
is written last. So a run may be killed at any moment and started again: it makes the scenes that have no
record.
"""

from __future__ import annotations

import gc
import logging

import drjit as dr

from datagen.clock import stage
from datagen.dataset.records import Record, Work, clear_work, read_record, scene_folder
from datagen.files.sources import Sources, ready_sources
from datagen.run.account import Failure, read_other, summary, write_account
from datagen.run.clusters import logs_folder, require_cluster
from datagen.run.cost import held_bytes
from datagen.run.plan import adopt, chosen, clear_temporaries
from datagen.run.scheduling import make_each
from datagen.run.store import Store
from datagen.settings.command import Settings, part_of
from datagen.sources import source_of
from tron.runtime import activate
from tron.storage import locked, require_free_space

log = logging.getLogger(__name__)


def make(settings: Settings) -> int:
    """Make the missing scenes of a dataset of either source; return the number of failed scenes and clips.

    Raises:
        TronError: wrong settings, a folder in use, made otherwise or not writable, a store that cannot be
            written, too little space: all before the first scene; or the store is gone, whenever that is.
    """
    source = source_of(settings)
    items = part_of(source.plan(settings), settings.shard)
    wanted = chosen(items, settings.only)
    require_cluster(settings)
    store = Store.of(settings)
    stored = store.shards() if store else {}
    activate(settings.variant, threads=1)
    sources = ready_sources(settings)
    other = read_other(settings.variety_against)
    output = settings.output_dir
    source.ready(settings)
    with locked(output):
        clear_temporaries(output)
        adopt(settings)
        missing = [item for item in wanted if read_record(output, item.name, stored) is None]
        for item in (item for item in wanted if item not in missing):
            clear_work(scene_folder(output, item.name))  # killed between its record and this
        failed: dict[str, Failure] = {}
        if missing:
            require_free_space(output, held_bytes(settings, missing))
            log.info("%d of %d scenes to make in %s", len(missing), len(items), output)
            failed = make_each(
                make_item, missing, settings, sources, lambda item: source.clips(item, settings), "clips"
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


def make_item(item: Work, settings: Settings, sources: Sources) -> Record:
    """Make one scene or capture, send its shards to the store, and release its memory. Runs in a worker."""
    record = source_of(settings).make(item, settings, sources)
    if settings.store is not None:
        with stage("upload"):
            Store(settings.store).send(settings.output_dir, record)
    gc.collect()
    dr.flush_malloc_cache()
    return record
