"""mode=merge: join parts of a dataset by hard links into one folder, with the bytes of a single run.

A part is a folder that tron-datagen made with the same settings: by shard=i/n, or by only=[...], on this
machine or another. Files of scenes are linked, records last; the account is written anew from the records. So
a merge that is interrupted goes on when the command is given again.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from datagen.dataset.records import CONFIG_NAME, RECORD_NAME, TRACEBACKS, WORK, Work, read_record
from datagen.files.sources import ready_sources
from datagen.run.account import ACCOUNT, LIST_NAME, Failure, read_other, summary, write_account
from datagen.run.clusters import logs_folder
from datagen.run.plan import adopt, clear_temporaries, plan
from datagen.run.store import Store
from datagen.settings.command import Settings
from datagen.sources import source_of
from tron.errors import TronError
from tron.run_folder import RunFolder
from tron.shards.schema import SCHEMA_VERSION
from tron.storage import atomic_path, locked

log = logging.getLogger(__name__)

APART = (*ACCOUNT, TRACEBACKS, "logs", "slurm")
"""Files and folders that the account is written anew to, or that no dataset is made of."""
NAMED = 3
UNLINKABLE = (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.ENOTSUP)
"""What a file system says that cannot link this file: another one, one without links, too many of them."""


def merge(settings: Settings) -> int:
    """Join the parts of a dataset in output_dir; return the number of failed scenes and clips.

    Nothing is copied where parts and output_dir lie on one file system. With a store, shards are there
    already, and the account of the whole is sent after them.

    Raises:
        TronError: no parts, one that is no dataset, of another recipe, in use or with a scene of another
            part, or, unless ``merge_incomplete``, a scene that is in none; all before the first link.
    """
    settings = settings.model_copy(update={"mode": "make", "shard": None})
    parts, output = settings.merge, settings.output_dir
    if not parts:
        raise TronError("mode=merge has no parts", mend="give their folders: merge=[PART1,PART2]")
    items, sources = plan(settings), ready_sources(settings)
    other = read_other(settings.variety_against)
    for part in parts:
        _require_part(part, settings)
    with ExitStack() as held:
        for part in parts:
            if part.resolve() == output.resolve():
                raise TronError("output_dir is one of its parts", output, "give another output_dir")
            held.enter_context(locked(part))
        files = _files(parts)
        store = Store.of(settings)
        stored = store.shards() if store else {}
        made = {
            item.name
            for item in items
            if any(read_record(part, item.name, stored) for part in parts if _has(part, item))
        }
        failed = _failures(parts, {item.name for item in items} - made)
        if not settings.merge_incomplete:
            _require_whole([item for item in items if item.name not in made and item.name not in failed])
        held.enter_context(locked(output))
        clear_temporaries(output)
        adopt(settings)
        _link_all(files, output)
        if store:
            store.empty(output, items)
            stored = store.shards()
        count = write_account(
            settings.model_copy(update={"merge": []}), items, sources, failed, other, stored
        )
        if store:
            store.finish(settings)
    log.info("%d of %d scenes of %d parts are in %s", len(made), len(items), len(parts), output)
    if count:
        log.error("%s", summary(count, output, logs_folder(settings)))
    return count


def _has(part: Path, item: Work) -> bool:
    return (part / "scenes" / item.name / RECORD_NAME).is_file()


def _require_part(part: Path, settings: Settings) -> None:
    """Refuse a folder that is not a part of the settings' dataset."""
    mend = "give folders that tron-datagen made with these settings"
    run = RunFolder(part, "a part", CONFIG_NAME, mend)
    old = run.recipe()
    if old is None:
        raise TronError("no config.yaml, so this is no part of a dataset", part, mend)
    if old.get("schema") != SCHEMA_VERSION:
        raise TronError(f"the part has schema {old.get('schema')}, not {SCHEMA_VERSION}", part, mend)
    recipe, scenes = old.get("recipe"), old.get("scenes")
    if not isinstance(recipe, dict) or not isinstance(scenes, dict):
        raise TronError("config.yaml is damaged", part / CONFIG_NAME, mend)
    run.require(
        {"scenes": source_of(settings).planned(settings), **settings.recipe()}, {"scenes": scenes, **recipe}
    )


def _files(parts: Sequence[Path]) -> dict[str, Path]:
    """Return name in the folder -> file to link; TronError if two parts have the same one."""
    found: dict[str, Path] = {}
    for part in parts:
        for name in _names(part):
            if name in found:
                first = found[name]
                raise TronError(f"{name} is in two parts", part, f"leave one out; the other is {first}")
            found[name] = part / name
    return found


def _names(part: Path) -> Iterator[str]:
    """Yield names of the files of scenes in a part, without its account and hidden files."""
    for folder, folders, names in os.walk(part):
        inner = Path(folder).relative_to(part)
        if inner == Path():
            folders[:] = [name for name in folders if name not in APART]
            names = [name for name in names if name not in APART]
        elif inner.parts[0] == "scenes":
            folders[:] = [name for name in folders if name != WORK]  # a link would let two runs write to one
        folders.sort()
        yield from ((inner / name).as_posix() for name in sorted(names) if not name.startswith("."))


def _failures(parts: Sequence[Path], unmade: set[str]) -> dict[str, Failure]:
    """Return scenes that failed in a part and are finished in none, by name."""
    found: dict[str, Failure] = {}
    for part in parts:
        path = part / LIST_NAME
        try:
            lines: list[Mapping[str, Any]] = (
                [json.loads(line) for line in path.read_text("utf-8").splitlines()] if path.is_file() else []
            )
            for line in lines:
                if line["scene"] in unmade and line["traceback"]:
                    text = (part / line["traceback"]).read_text("utf-8")
                    found[line["scene"]] = Failure(line["reason"], text)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise TronError(f"list of failures is damaged: {error}", path, "make this part again") from error
    return found


def _require_whole(missing: Sequence[Work]) -> None:
    if missing:
        named = ", ".join(item.name for item in missing[:NAMED])
        more = f" and {len(missing) - NAMED} more" if len(missing) > NAMED else ""
        raise TronError(
            f"scenes are in none of the parts: {named}{more}",
            mend="make them and give their part too, or say merge_incomplete=true",
        )


def _link_all(files: Mapping[str, Path], output: Path) -> None:
    """Link every file into a folder, records last, because a scene without a record does not count."""
    copied = 0
    for name in sorted(files, key=lambda name: (name.endswith(f"/{RECORD_NAME}"), name)):
        copied += link(files[name], output / name)
    if copied:
        log.warning("%d files were copied: their file system cannot be linked from %s", copied, output)


def link(source: Path, target: Path) -> bool:
    """Link a file, or copy it if linking fails, whole or not at all. Return whether it was copied."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.is_file() and (os.path.samefile(source, target) or _same(source, target)):
        return False
    try:
        half = target.with_name(f".{target.stem}.part{target.suffix}")
        half.unlink(missing_ok=True)
        os.link(source, half)
        os.replace(half, target)
        return False
    except OSError as error:
        if error.errno not in UNLINKABLE:
            raise TronError(f"cannot link: {error.strerror or error}", target) from error
    with atomic_path(target) as half:
        shutil.copyfile(source, half)
        shutil.copystat(source, half)
    return True


def _same(source: Path, target: Path) -> bool:
    """Whether a file was copied before: size and time are equal."""
    a, b = source.stat(), target.stat()
    return (a.st_size, a.st_mtime_ns) == (b.st_size, b.st_mtime_ns)
