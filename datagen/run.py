"""Making what the plan says: scenes spread over a Dask cluster, results kept as they come, the rest accounted
for.

Everything a worker leaves behind is whole (atomic writes) and depends on the plan alone, and a scene's record
is written last. So a run may be killed at any moment and started again: it makes the scenes that have no
record.
"""

from __future__ import annotations

import gc
import hashlib
import io
import json
import logging
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import numpy as np

from datagen.assets import for_split, load_models
from datagen.build import Geometry, build
from datagen.card import card_text, command_line
from datagen.clusters import ours, recycle, require_cluster, workers
from datagen.models import outline
from datagen.plan import (
    RECORD_NAME,
    Quarantined,
    Record,
    Sources,
    Work,
    adopt,
    chosen,
    clear_temporaries,
    config_sha256,
    estimate_bytes,
    find_sources,
    plan,
    read_record,
    scene_folder,
)
from datagen.preview import contact_row, index_html, sheet_name, write_sheet
from datagen.scene import SceneSpec, draw_scene
from datagen.settings import SPLITS, LightChoice, Settings
from datagen.synthetic import first_bad_value, make_clips, make_surfels
from tron.cli.progress import Progress
from tron.errors import TronError
from tron.runtime import activate
from tron.shards.manifest import Manifest
from tron.shards.writer import ShardWriter
from tron.storage import locked, require_free_space, write_atomic, write_if_changed

log = logging.getLogger(__name__)

FAILURES_NAME = "failures.jsonl"
Made = TypeVar("Made")
Task = Callable[[Work, Settings, Sources], Made]
"""What makes something of one scene, in a worker; it can be pickled."""


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
    output = settings.output_dir
    with locked(output):
        clear_temporaries(output)
        adopt(settings)
        missing = [item for item in wanted if read_record(output, item) is None]
        reasons: dict[str, str] = {}
        if missing:
            require_free_space(output, estimate_bytes(settings, missing))
            log.info("%d of %d scenes to make in %s", len(missing), len(items), output)
            clips = {item: len(settings.split(item.split).lights) for item in missing}
            with Progress("scenes", sum(clips.values()), unit="clips") as progress:
                for item, outcome in outcomes(make_scene, missing, settings, sources):
                    if isinstance(outcome, str):
                        reasons[item.name] = outcome
                        log.error("%s failed: %s", item.name, outcome)
                    progress.advance(clips[item], item.name)
        failures = _account(settings, items, sources, reasons)
    if failures:
        log.error("%d failures, listed in %s", failures, output / FAILURES_NAME)
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
    surfels, refinement = make_surfels(spec, geometry, settings)
    surfels.save(folder / "surfels.ply")

    quarantined: list[Quarantined] = []
    rows: dict[str, np.ndarray] = {}
    with ShardWriter(output, item.split, settings.clips_per_shard, item.first_shard) as writer:
        for meta, frames in make_clips(spec, geometry, surfels, settings):
            problem = first_bad_value(frames)
            if problem is not None:
                quarantined.append(Quarantined(key=meta.key, reason=problem))
                _set_aside(output / "quarantine" / f"{meta.key}.npz", frames)
                continue
            writer.write(meta, frames)
            rows[meta.key] = contact_row(meta, frames[0])
    for entry in writer.entries:
        write_sheet(output / sheet_name(entry.name), [rows[key] for key in entry.keys])
    record = Record(name=item.name, shards=writer.entries, quarantined=quarantined, refinement=refinement)
    write_atomic(folder / RECORD_NAME, record.model_dump_json(indent=1) + "\n")
    del geometry, surfels
    gc.collect()
    dr.flush_malloc_cache()
    return record


def draw_and_build(
    item: Work, settings: Settings, sources: Sources, lights: Sequence[LightChoice]
) -> tuple[SceneSpec, Geometry]:
    """A scene's specification, with a light of each of the given families, and its meshes."""
    recipe = settings.split(item.split)
    models = load_models(settings.assets, sources.assets) if settings.assets is not None else {}
    spec = draw_scene(
        settings.seed,
        item.split,
        item.index,
        style=recipe.style,
        lights=lights,
        families=settings.light_families(),
        environments=for_split(sources.environments, item.split),
        assets={name: outline(parts) for name, parts in models.items()},
        asset_share=settings.asset_share,
        objects=settings.objects,
        frames=recipe.frames,
        path_frames=settings.path_frames,
    )
    return spec, build(spec, models, settings.mesh_edge)


def _set_aside(path: Path, frames: Sequence[dict[str, np.ndarray]]) -> None:
    buffer = io.BytesIO()
    arrays = {member: np.stack([frame[member] for frame in frames]) for member in frames[0]}
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_atomic(path, buffer.getvalue())


def attempt(task: Task[Made], item: Work, settings: Settings, sources: Sources) -> Made | str:
    """Do a task, with whatever goes wrong as one line: one scene's failure is not the run's."""
    try:
        return task(item, settings, sources)
    except Exception as error:
        log.debug("scene %s", item.name, exc_info=True)
        text = str(error) if isinstance(error, TronError) else f"{type(error).__name__}: {error}"
        return " ".join(text.split())


def outcomes(
    task: Task[Made], items: Sequence[Work], settings: Settings, sources: Sources
) -> Iterator[tuple[Work, Made | str]]:
    """Do a task for every scene, here or on the cluster: what it gave, or the reason why it gave nothing, as
    scenes are finished, in any order.
    """
    if settings.cluster is None:
        for item in items:
            yield item, attempt(task, item, settings, sources)
        return
    from dask.distributed import as_completed

    with workers(settings, len(items)) as client:
        queue = iter(items)
        mine = ours(settings)
        while wave := list(islice(queue, _count(client) * settings.recycle_after if mine else None)):
            futures = {
                client.submit(
                    attempt, task, item, settings, sources, key=_key(settings, item), pure=False
                ): item
                for item in wave
            }
            for future in as_completed(futures):
                # A worker that died (killed for memory, crashed in native code) surfaces here, after Dask's
                # retries.
                error = future.exception()
                yield futures[future], f"worker lost: {error}" if error is not None else future.result()
            if mine and len(wave) < len(items):
                recycle(client, settings.worker_timeout)


def _key(settings: Settings, item: Work) -> str:
    """A task's name on a scheduler that may serve several runs."""
    return f"{item.name}-{hashlib.sha256(str(settings.output_dir.absolute()).encode()).hexdigest()[:16]}"


def _count(client: Any) -> int:
    return max(len(client.scheduler_info(n_workers=-1)["workers"]), 1)


def _account(settings: Settings, items: Sequence[Work], sources: Sources, reasons: dict[str, str]) -> int:
    """Write failures, manifest, card and index from the records; return the number of failures."""
    output = settings.output_dir
    records = {item.name: read_record(output, item) for item in items}
    known = {entry["scene"]: entry for entry in _read_failures(output / FAILURES_NAME)}
    failures: list[dict[str, Any]] = []
    for item in items:
        record = records[item.name]
        if record is not None:
            failures += [failure(settings, item, q.reason, q.key) for q in record.quarantined]
        elif item.name in reasons:
            failures.append(failure(settings, item, reasons[item.name]))
        elif item.name in known:
            failures.append(known[item.name])
    write_failures(output / FAILURES_NAME, failures)

    made = [record for record in records.values() if record is not None]
    shards = sorted((entry for record in made for entry in record.shards), key=lambda entry: entry.name)
    manifest = Manifest(config_sha256=config_sha256(settings), shards=shards, failures=len(failures))
    lights = {split: Counter[str]() for split in SPLITS}
    for record in made:
        spec = SceneSpec.model_validate_json((scene_folder(output, record.name) / "spec.json").read_bytes())
        kept = {key for entry in record.shards for key in entry.keys}
        lights[spec.split].update(
            light.family for i, light in enumerate(spec.lights) if f"{spec.name}-l{i}" in kept
        )
    refinements = [record.refinement for record in made if record.refinement is not None]
    write_if_changed(output / "card.md", card_text(settings, manifest, sources, lights, refinements))
    write_if_changed(output / "index.html", index_html("TRON dataset", shards))
    manifest.save(output)
    return len(failures)


def write_failures(path: Path, failures: Sequence[dict[str, Any]]) -> None:
    """One line of JSON a failure; no file where there is none."""
    if failures:
        write_if_changed(path, "".join(json.dumps(each) + "\n" for each in failures))
    else:
        path.unlink(missing_ok=True)


def failure(settings: Settings, item: Work, reason: str, clip: str | None = None) -> dict[str, Any]:
    """What failures.jsonl says of a scene, clip or capture: with the command that tries it again."""
    return {
        "scene": item.name,
        "clip": clip,
        "split": item.split,
        "index": item.index,
        "seed": settings.seed,
        "reason": reason,
        "command": command_line(settings, str(settings.output_dir), only=[item.name]),
    }


def _read_failures(path: Path) -> list[dict[str, Any]]:
    try:
        return [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    except (OSError, ValueError):
        return []
