"""Find every problem of a dataset folder: in its shards, in their scenes, and in its captures."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from datagen.files.sources import overlaps, read_source_list, shared_scenes
from datagen.photographs.camera_model import CAPTURES, RELIT, TRUTH
from datagen.photographs.manifest import capture_names, verify_captures
from tron.shards.manifest import MANIFEST_NAME, Manifest
from tron.shards.reader import verify

log = logging.getLogger(__name__)

CHECKED = (
    (CAPTURES, "capture", "captures"),
    (TRUTH, "folder of their truth", "folders of their truth"),
    (RELIT, "folder of relit views", "folders of relit views"),
)
"""Folders of captures below a dataset's, and what one of theirs is called."""


def validate(folder: Path, disjoint_from: Sequence[Path] = (), store: str | None = None) -> int:
    """Log every problem of a dataset and of the captures beside it, one line each, and return their number.

    Beside what ``tron.shards.verify`` finds in the shards, every scene that has clips must still
    have its specification and its surfels. A folder may hold captures alone. What it shares with the
    datasets of ``disjoint_from`` is a problem too. With a store, its shards and manifest are looked at, and
    nothing else.

    Raises:
        TronError: the folder holds neither a dataset nor captures; one of ``disjoint_from`` has no list of
            its sources.
    """
    if store is not None:
        return _store_problems(store)
    captures = folder / CAPTURES
    problems = [
        f"{name}/{problem}"
        for name, _, _ in CHECKED
        if (folder / name).is_dir()
        for problem in verify_captures(folder / name)
    ]
    if (folder / MANIFEST_NAME).exists() or not captures.is_dir():
        problems = _dataset_problems(folder) + problems
        if disjoint_from:
            own = read_source_list(folder)
            for other in disjoint_from:
                problems += overlaps(own, read_source_list(other), other)
            problems += shared_scenes(folder, disjoint_from)
    else:
        log.info("no dataset here, captures alone")
    for problem in problems:
        log.error("%s", problem)
    if found := [
        _number(len(capture_names(folder / name)), one, several)
        for name, one, several in CHECKED
        if (folder / name).is_dir()
    ]:
        log.info("checked, file by file: %s", ", ".join(found))
    log.info("%s", _number(len(problems), "problem"))
    return len(problems)


def _number(count: int, one: str, several: str = "") -> str:
    return f"{count} {one if count == 1 else several or one + 's'}"


def _store_problems(store: str) -> int:
    problems = verify(store)
    for problem in problems:
        log.error("%s", problem)
    log.info("%s in %s", _number(len(problems), "problem"), store)
    return len(problems)


def _dataset_problems(folder: Path) -> list[str]:
    problems = verify(folder)
    manifest = Manifest.load(folder)
    scenes = sorted({key.rsplit("-l", 1)[0] for entry in manifest.shards for key in entry.keys})
    for scene in scenes:
        for name in ("spec.json", "surfels.ply"):
            if not (folder / "scenes" / scene / name).is_file():
                problems.append(f"scenes/{scene}/{name}: missing")
    clips = sum(entry.samples for entry in manifest.shards)
    log.info("%s, %s", _number(len(manifest.shards), "shard"), _number(clips, "clip"))
    return problems
