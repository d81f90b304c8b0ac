"""Account of a dataset, rewritten from its records after every run; unchanged files are left alone.

Each failure has a line in failures.jsonl, and its traceback in a file.
"""

from __future__ import annotations

import json
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.dataset.clip_preview import SHEET_NAME, scenes_sheet, sheet_name
from datagen.dataset.pages import METADATA_NAME, card_text, index_page, metadata_parquet
from datagen.dataset.records import CONFIG_NAME, NOTHING, TRACEBACKS, Quarantined, Work, read_record
from datagen.dataset.variety import MEASURES, VARIETY_NAME, Histograms, shard_histograms, total
from datagen.files.sources import SOURCES_NAME, Sources, source_list
from datagen.run.plan import config_sha256
from datagen.settings.command import Settings
from datagen.settings.command_line import command_line
from tron.errors import TronError
from tron.estimation import MATERIAL
from tron.report.charts import Histogram, histograms_png
from tron.shards.manifest import MANIFEST_NAME, Manifest
from tron.shards.schema import META_SCHEMA_NAME, meta_schema
from tron.storage import write_if_changed

LIST_NAME = "failures.jsonl"
CARD_NAME = "README.md"
PAGE_NAME = "index.html"
ACCOUNT = (
    CONFIG_NAME,
    CARD_NAME,
    SOURCES_NAME,
    METADATA_NAME,
    META_SCHEMA_NAME,
    SHEET_NAME,
    VARIETY_NAME,
    PAGE_NAME,
    LIST_NAME,
    MANIFEST_NAME,
)
"""Files that are of the whole dataset and of no scene, the manifest last."""
MOST_LINKS = 12
"""Shards whose sheets the page links; the others lie beside them in previews/."""


def read_other(folder: Path | None) -> dict[str, Histograms]:
    """Read another dataset's histograms, by folder name; from its shards if its records have none.

    Raises:
        TronError: it is no dataset of this schema, or a shard is damaged.
    """
    if folder is None:
        return {}
    manifest = Manifest.load(folder)
    scenes = {key.rsplit("-l", 1)[0] for entry in manifest.shards for key in entry.keys}
    records = [read_record(folder, name) for name in sorted(scenes)]
    counted = all(record is not None and record.variety for record in records)
    found = total(r.variety for r in records if r is not None) if counted else shard_histograms(folder)
    return {folder.resolve().name: found}


def write_account(
    settings: Settings,
    items: Sequence[Work],
    sources: Sources,
    failed: Mapping[str, Failure],
    other: Mapping[str, Histograms],
    stored: Mapping[str, int] = NOTHING,
) -> int:
    """Write failures, manifest, card, tables, sheets and page from the records; return the failures' number.

    Args:
        settings, items, sources: of the dataset.
        failed: scenes that failed in this run.
        other: histograms of another dataset by its name, to draw beside these; empty without one.
        stored: bytes of the shards in its store, by name.
    """
    output = settings.output_dir
    made = [record for item in items if (record := read_record(output, item.name, stored)) is not None]
    finished = {record.name: record.quarantined for record in made}
    failures = record_failures(output, settings, items, failed, finished)
    shards = sorted((entry for record in made for entry in record.shards), key=lambda entry: entry.name)
    manifest = Manifest(
        config_sha256=config_sha256(settings), shards=shards, failures=failures, material=MATERIAL
    )
    rows = [row for record in made for row in record.clips]

    listed = source_list(settings, sources)
    write_if_changed(output / SOURCES_NAME, listed.model_dump_json(indent=1) + "\n")
    write_if_changed(output / METADATA_NAME, metadata_parquet(rows))
    write_if_changed(output / META_SCHEMA_NAME, json.dumps(meta_schema(), indent=1) + "\n")
    sheet = scenes_sheet(output, rows)
    if sheet is not None:
        write_if_changed(output / SHEET_NAME, sheet)
    own = total(record.variety for record in made)
    named = {"this dataset": own, **other}
    if own:
        write_if_changed(output / VARIETY_NAME, _variety_png(named))
    shown = [name for name in (SHEET_NAME, VARIETY_NAME) if (output / name).is_file()]
    text = card_text(settings, manifest, sources, listed, made, named if own else {}, shown)
    write_if_changed(output / CARD_NAME, text)
    links = {CARD_NAME: CARD_NAME, METADATA_NAME: METADATA_NAME} | {name: name for name in shown}
    links |= {f"{entry.name}, all members": sheet_name(entry.name) for entry in shards[:MOST_LINKS]}
    write_if_changed(output / PAGE_NAME, index_page("TRON dataset", rows, links))
    manifest.save(output)
    return failures


def _variety_png(named: Mapping[str, Histograms]) -> bytes:
    shown = [
        Histogram(
            measure.title,
            measure.edges,
            {label: counts[name] for label, counts in named.items() if name in counts},
            measure.logarithmic,
        )
        for name, measure in MEASURES.items()
    ]
    return histograms_png(shown, list(named))


@dataclass(frozen=True)
class Failure:
    """The error that ended a task.

    Attributes:
        reason: one line.
        traceback: as Python prints it.
    """

    reason: str
    traceback: str

    @classmethod
    def of(cls, error: BaseException, lead: str = "") -> Failure:
        """Return an exception as a failure; ``lead`` precedes its message."""
        text = str(error) if lead or isinstance(error, TronError) else f"{type(error).__name__}: {error}"
        return cls(" ".join(f"{lead}{text}".split()), "".join(traceback.format_exception(error)))


def record_failures(
    folder: Path,
    settings: Settings,
    items: Sequence[Work],
    failed: Mapping[str, Failure],
    finished: Mapping[str, Sequence[Quarantined]],
) -> int:
    """Write the list and the tracebacks of a folder; finished scenes leave both.

    Args:
        folder: folder of the list.
        settings: settings of the run, repeated in the command of a line.
        items: scenes to account for. One that neither failed now nor is finished keeps its line.
        failed: scenes that failed in this run, by name.
        finished: finished scenes by name, with their clips, good and set aside.

    Returns:
        The number of failures, scenes and clips.
    """
    known = {line["scene"]: line for line in _read(folder / LIST_NAME)}
    lines: list[dict[str, Any]] = []
    for item in items:
        if item.name in finished:
            lines += [_line(settings, item, clip.reason, clip.key) for clip in finished[item.name]]
        elif item.name in failed:
            path = f"{TRACEBACKS}/{item.name}.txt"
            write_if_changed(folder / path, failed[item.name].traceback)
            lines.append(_line(settings, item, failed[item.name].reason, traceback=path))
        elif item.name in known:
            lines.append(known[item.name])
    kept = {line.get("traceback") for line in lines}
    for path in (folder / TRACEBACKS).glob("*.txt"):
        if path.relative_to(folder).as_posix() not in kept:
            path.unlink()
    with suppress(OSError):  # not there, or not empty
        (folder / TRACEBACKS).rmdir()
    if lines:
        write_if_changed(folder / LIST_NAME, "".join(json.dumps(line) + "\n" for line in lines))
    else:
        (folder / LIST_NAME).unlink(missing_ok=True)
    return len(lines)


def summary(count: int, folder: Path, logs: Path) -> str:
    """Return a line with the number of failures and the file that lists them."""
    text = f"{count} failures, listed in {folder / LIST_NAME}"
    if (folder / TRACEBACKS).is_dir():
        text += f", tracebacks in {folder / TRACEBACKS}"
    return f"{text}, workers' logs in {logs}" if logs.is_dir() else text


def _line(
    settings: Settings, item: Work, reason: str, clip: str | None = None, traceback: str | None = None
) -> dict[str, Any]:
    """Return the line of a scene, clip or capture, with the command that tries it again."""
    return {
        "scene": item.name,
        **({"capture": item.capture} if item.capture else {}),
        "clip": clip,
        "split": item.split,
        "index": item.index,
        "seed": settings.seed,
        "reason": reason,
        "traceback": traceback,
        "command": command_line(settings, str(settings.output_dir), only=[item.name]),
    }


def _read(path: Path) -> list[dict[str, Any]]:
    try:
        return [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    except (OSError, ValueError):
        return []
