"""mode=plan: what the missing scenes of a dataset will take, before anything of them is rendered."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from datagen.account import read_other
from datagen.captured_reconstruction import require_prior
from datagen.captured_reuse import require_reusable
from datagen.clusters import LOCAL, logs_folder, require_cluster, worker_count
from datagen.first_limit import first_limit
from datagen.plan import (
    NOTHING,
    Work,
    chosen,
    kept_bytes,
    plan,
    read_record,
    require_adoptable,
    scene_folder,
)
from datagen.probe import SceneCost, probe
from datagen.ready_sources import ready_sources
from datagen.scale_settings import part_of
from datagen.scheduling import TIMES_NAME
from datagen.settings import Settings
from datagen.source_list import slots
from datagen.store import Store, held_bytes
from tron.cli.termination import termination_unwinds
from tron.runtime import activate

log = logging.getLogger(__name__)

SECONDS_A_STEP = 0.12
SECONDS_A_PIXEL = 4e-5
"""Processor seconds of an optimisation step, and of guidance a pixel of a photo's frame.

Fitted to 16 pseudo-captures of 40 to 53 photos of 160 x 120 (2026-11-23): 7.6 minutes of processor each at
3,700 steps and frames of 128 x 96 with 32 rays, 95 % of it the reconstruction.
"""
ROUGHLY = "a rough law, within a factor of two"

NAMED = 4
"""Missing scenes that are named."""


@dataclass(frozen=True)
class SplitPlan:
    """One split: its scenes, those to make, and what one of them costs (None where none is missing)."""

    name: str
    scenes: int
    missing: Sequence[Work]
    cost: SceneCost | None


def project(settings: Settings) -> str:
    """The plan as text: tables of scenes, bytes, hours and memory, and what is missing.

    Scenes that are there already stand for those that are not, with their bytes and the seconds in
    logs/times.jsonl; where there is none, a probe is rendered and thrown away. Nothing is written to
    output_dir.

    Raises:
        TronError: wherever making the dataset would, before its first scene.
    """
    items = part_of(plan(settings), settings.shard)
    wanted = chosen(items, settings.only)
    require_cluster(settings)
    require_adoptable(settings)
    activate(settings.variant, threads=1)
    sources = ready_sources(settings)
    if settings.variety_against is not None:
        read_other(settings.variety_against)
    if settings.source == "captured":
        require_prior(settings)
        require_reusable(settings)
    stored = Store(settings.store).shards() if settings.store else NOTHING
    output = settings.output_dir
    there = {item.name for item in items if read_record(output, item.name, stored) is not None}
    times = read_times(logs_folder(settings) / TIMES_NAME)
    splits = []
    for split in settings.used_splits():
        missing = [item for item in wanted if item.split == split and item.name not in there]
        cost = None
        if missing:
            made = [item for item in items if item.split == split and item.name in there]
            cost = _of_made(settings, made, times, stored)
            if cost is None and settings.source == "captured":
                cost = captured_cost(missing, settings)
            elif cost is None:
                log.info("a small scene of %s is rendered to see what it costs", split)
                with termination_unwinds():  # the probe's clips wait in a folder that goes away
                    cost = probe(missing[0], settings, sources)
        splits.append(SplitPlan(split, sum(item.split == split for item in items), missing, cost))
    checked = slots(settings, sources)
    slot_lines = [checked.report(settings.environments, settings.assets), ""] if checked else []
    return "\n".join([*slot_lines, report(settings, splits)])


def read_times(path: Path) -> dict[str, float]:
    """Seconds of each scene in times.jsonl that was made, its last; lines that cannot be read are none.

    Captures bear the names of the test split's scenes, and their lines are none of a dataset's.
    """
    found: dict[str, float] = {}
    for line in path.read_text("utf-8").splitlines() if path.is_file() else ():
        try:
            noted = json.loads(line)
            if noted["made"] and noted.get("mode", "make") == "make":
                found[noted["scene"]] = sum(noted["seconds"].values())
        except (ValueError, KeyError, TypeError, AttributeError):
            continue
    return found


def _of_made(
    settings: Settings, made: Sequence[Work], times: Mapping[str, float], stored: Mapping[str, int]
) -> SceneCost | None:
    """Mean cost of the scenes that are there and whose seconds are known."""
    timed = [item.name for item in made if item.name in times]
    if not timed:
        return None
    sizes = [scene_bytes(settings.output_dir, name, stored) for name in timed]
    source = f"{len(timed)} scene{'s' * (len(timed) > 1)} made here"
    return SceneCost(fmean(times[name] for name in timed), fmean(sizes), float("nan"), source)


def captured_cost(missing: Sequence[Work], settings: Settings) -> SceneCost:
    """Mean cost of captures of which none is made yet: bytes by their photos, seconds by a rough law.

    The law is :data:`SECONDS_A_STEP` for the steps, none where a reconstruction is taken over, and
    :data:`SECONDS_A_PIXEL` for guidance. Larger photos take longer. Bytes are of what stays alone: what
    waits on disk is no scene's own.
    """
    wanted = settings.captured
    photos = fmean(item.photos + item.relit for item in missing)
    how = wanted.reconstruction
    steps = how.steps_scaler * (how.radiance.steps + how.materials.steps)
    if wanted.reconstructed is not None:
        steps = 0
    pixels = photos * wanted.width * wanted.height
    seconds = SECONDS_A_STEP * steps + SECONDS_A_PIXEL * pixels
    return SceneCost(seconds, kept_bytes(settings, missing) / len(missing), float("nan"), ROUGHLY)


def scene_bytes(output: Path, name: str, stored: Mapping[str, int] = NOTHING) -> int:
    """Bytes of a finished scene: its shards, wherever they are, surfels and previews."""
    record = read_record(output, name, stored)
    if record is None:
        return 0
    folders = (scene_folder(output, name).glob("*.*"), (output / "previews").glob(f"{name}-l*"))
    return sum(entry.bytes for entry in record.shards) + sum(
        path.stat().st_size for folder in folders for path in folder
    )


def report(settings: Settings, splits: Sequence[SplitPlan]) -> str:
    """The text of a plan."""
    rows = [
        ("split", "scenes", "to make", "clips", "frames", "size", "GB", "core hours", "measured by"),
        *(_row(settings, split) for split in splits),
    ]
    missing = [item for split in splits for item in split.missing]
    total_bytes = sum(len(split.missing) * split.cost.bytes for split in splits if split.cost)
    seconds = sum(len(split.missing) * split.cost.seconds for split in splits if split.cost)
    memory = [split.cost.memory for split in splits if split.cost and split.cost.memory > 0]
    count, known = worker_count(settings, len(missing))
    needed = held_bytes(settings, missing) if missing else 0
    free = shutil.disk_usage(_existing(settings.output_dir)).free
    facts = [
        ("scenes to make", f"{len(missing)} of {sum(split.scenes for split in splits)}{_names(missing)}"),
        ("bytes on disk", f"{total_bytes / 1e9:.3g} GB"),
        (
            "asked for",
            f"{needed / 1e9:.3g} GB before the first scene: as if nothing compressed, with what waits "
            f"on disk in {count} scene{'s' * (count > 1)} under way",
        ),
        (
            "free",
            f"{free / 1e9:.3g} GB on the disk of {settings.output_dir}: "
            + ("enough" if free > needed else "NOT ENOUGH"),
        ),
        ("memory", f"about {max(memory) / 1e9:.2g} GB a worker" if memory else "not measured"),
        ("core hours", f"{seconds / 3600:.3g}, by cores as fast as this one"),
        (
            "wall hours",
            f"{seconds / 3600 / count:.3g} with {count} worker{'s' * (count > 1)}{known}"
            if missing
            else "none: nothing is missing",
        ),
        (
            "binds first",
            first_limit(
                needed=needed,
                free=free,
                memory=max(memory, default=0.0),
                workers=count,
                here=settings.cluster is None or settings.cluster["_target_"] == LOCAL,
                seconds=seconds,
                written=total_bytes,
            ),
        ),
    ]
    return "\n".join([*_aligned(rows), "", *_aligned(facts)])


def _row(settings: Settings, split: SplitPlan) -> tuple[str, ...]:
    recipe, number = settings.split(split.name), len(split.missing)
    cost = split.cost or SceneCost(0.0, 0.0, 0.0, "")
    clips = sum(item.clips(settings) for item in split.missing)
    return (
        split.name,
        str(split.scenes),
        str(number),
        str(clips),
        str(sum(item.frames(settings) for item in split.missing)),
        f"{recipe.width} x {recipe.height}",
        f"{number * cost.bytes / 1e9:.3g}",
        f"{number * cost.seconds / 3600:.3g}",
        cost.source,
    )


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows]


def _names(missing: Sequence[Work]) -> str:
    if not missing:
        return ""
    shown = ", ".join(item.name for item in missing[:NAMED])
    return f": {shown}{f', ... {missing[-1].name}' if len(missing) > NAMED else ''}"


def _existing(folder: Path) -> Path:
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return folder
