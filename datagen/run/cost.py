"""Estimate the cost of a dataset before it is made, from its source's costs per scene; mode=plan."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path

from datagen.dataset.records import NOTHING, Work, read_record
from datagen.files.sources import ready_sources, slots
from datagen.run.account import read_other
from datagen.run.clusters import LOCAL, cores, require_cluster, worker_count
from datagen.run.plan import chosen, plan, require_adoptable
from datagen.run.store import Store
from datagen.settings.command import Settings, part_of
from datagen.sources import source_of
from tron.runtime import activate

HELD_SCENES = 2  # with a store: scenes a worker whose shards lie here at once, one written, one sent

PATIENCE = 20.0  # times its cost that a scene may take before it counts as hung
LEAST_SECONDS = 600.0  # that every scene may take: compiling kernels on a busy machine is no hang
UNKNOWN_SECONDS = 86_400.0  # that a capture to be rendered may take, whose cost no table holds
NAMED = 4  # missing scenes that the plan names


def time_limit(item: Work, settings: Settings) -> float:
    """Return the time limit of a scene in seconds: the setting, or PATIENCE times its cost."""
    if settings.scene_timeout is not None:
        return settings.scene_timeout
    if settings.mode != "make":
        return UNKNOWN_SECONDS
    return max(PATIENCE * source_of(settings).cost(item, settings).seconds, LEAST_SECONDS)


def estimate_bytes(settings: Settings, items: Iterable[Work], shards: bool = True) -> int:
    """Return the maximum bytes on disk while making scenes: kept files, and scratch of concurrent scenes.

    Args:
        settings: the recipe.
        items: scenes to make.
        shards: whether to include their shards.
    """
    items, source = list(items), source_of(settings)
    waiting = max((source.scratch_bytes(item, settings) for item in items), default=0)
    return source.kept_bytes(settings, items, shards) + waiting * worker_count(settings, len(items))[0]


def held_bytes(settings: Settings, items: Sequence[Work]) -> int:
    """Return the maximum bytes in output_dir; with a store, only a few scenes' shards are there at once."""
    whole = estimate_bytes(settings, items)
    if settings.store is None or not items:
        return whole
    stays = estimate_bytes(settings, items, shards=False)
    largest = max(estimate_bytes(settings, [item]) for item in items)
    return min(whole, stays + HELD_SCENES * (settings.workers or cores()) * largest)


def project(settings: Settings) -> str:
    """Return the plan as text: scenes, bytes and hours by split, then missing scenes and their cost.

    Nothing is rendered, and nothing is written.

    Raises:
        TronError: wherever making the dataset would, before its first scene.
    """
    items = part_of(plan(settings), settings.shard)
    wanted = chosen(items, settings.only)
    require_cluster(settings)
    require_adoptable(settings)
    activate(settings.variant, threads=1)
    sources = ready_sources(settings)
    read_other(settings.variety_against)
    source_of(settings).ready(settings)
    stored = Store(settings.store).shards() if settings.store else NOTHING
    missing = [item for item in wanted if read_record(settings.output_dir, item.name, stored) is None]
    checked = slots(settings, sources)
    slot_lines = [checked.report(settings.environments, settings.assets), ""] if checked else []
    return "\n".join([*slot_lines, report(settings, items, missing)])


def report(settings: Settings, items: Sequence[Work], missing: Sequence[Work]) -> str:
    """Return the text of a plan of these scenes, some of which are missing."""
    source = source_of(settings)
    costs = {item.name: source.cost(item, settings) for item in missing}
    rows = [("split", "scenes", "to make", "clips", "frames", "size", "GB", "core hours")]
    for name in settings.used_splits():
        recipe, there = settings.split(name), [item for item in missing if item.split == name]
        rows.append(
            (
                name,
                str(sum(item.split == name for item in items)),
                str(len(there)),
                str(sum(source.clips(item, settings) for item in there)),
                str(sum(source.frames(item, settings) for item in there)),
                f"{recipe.width} x {recipe.height}",
                f"{sum(costs[item.name].bytes for item in there) / 1e9:.3g}",
                f"{sum(costs[item.name].seconds for item in there) / 3600:.3g}",
            )
        )
    hours = sum(cost.seconds for cost in costs.values()) / 3600
    memory = max((cost.memory for cost in costs.values()), default=0.0)
    count, known = worker_count(settings, len(missing))
    needed, free = held_bytes(settings, missing), shutil.disk_usage(_existing(settings.output_dir)).free
    named = ", ".join(item.name for item in missing[:NAMED])
    more = f", ... {missing[-1].name}" if len(missing) > NAMED else ""
    workers = f"{count} worker{'s' * (count > 1)}{known}"
    wall = f"{hours / count:.3g} with {workers}" if missing else "none: nothing is missing"
    facts = [
        ("scenes to make", f"{len(missing)} of {len(items)}{f': {named}{more}' if missing else ''}"),
        ("bytes on disk", f"{sum(cost.bytes for cost in costs.values()) / 1e9:.3g} GB"),
        (
            "asked for",
            f"{needed / 1e9:.3g} GB before the first scene: uncompressed, with what waits on disk",
        ),
        (
            "free",
            f"{free / 1e9:.3g} GB on the disk of {settings.output_dir}: "
            + ("enough" if free > needed else "NOT ENOUGH; store=URL sends shards away"),
        ),
        ("memory", _memory(settings, memory, count) if memory else "not known"),
        ("core hours", f"{hours:.3g}, within a factor of two"),
        ("wall hours", wall),
    ]
    return "\n".join([*_aligned(rows), "", *_aligned(facts)])


def _memory(settings: Settings, each: float, count: int) -> str:
    """Return the memory of a worker, and how many fit into this machine if they share it."""
    text = f"about {each / 1e9:.2g} GB a worker"
    here = settings.cluster is None or settings.cluster["_target_"] == LOCAL
    there = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return f"{text}: NOT ENOUGH, {int(there // each)} fit" if here and count * each > there else text


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows]


def _existing(folder: Path) -> Path:
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return folder
