"""Account of a dataset, written anew from its records after every run, and only where it changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from datagen.card import card_text
from datagen.clip_rows import ClipRow, rows_of_shard
from datagen.contact_sheet import SHEET_NAME, contact_sheet
from datagen.failures import LIST_NAME, Failure, record_failures
from datagen.hub import METADATA_NAME, metadata_parquet
from datagen.page.index_page import index_page
from datagen.plan import CONFIG_NAME, NOTHING, Record, Sources, Work, config_sha256, read_record
from datagen.preview import sheet_name
from datagen.settings import Settings
from datagen.source_list import SOURCES_NAME, source_list
from datagen.variety import MEASURES, VARIETY_NAME, Histograms, Other, shard_histograms, total
from tron.report.histograms import Histogram, histograms_png
from tron.shards.manifest import MANIFEST_NAME, Manifest
from tron.storage import write_if_changed

CARD_NAME = "README.md"
PAGE_NAME = "index.html"
ACCOUNT = (
    CONFIG_NAME,
    CARD_NAME,
    SOURCES_NAME,
    METADATA_NAME,
    SHEET_NAME,
    VARIETY_NAME,
    PAGE_NAME,
    LIST_NAME,
    MANIFEST_NAME,
)
"""Files that are of the whole dataset and of no scene, the manifest last."""


def read_other(folder: Path) -> Other:
    """Histograms of another dataset, from its records, or from its shards where these hold none.

    Raises:
        TronError: it is no dataset of this schema, or a shard is damaged.
    """
    manifest = Manifest.load(folder)
    scenes = {key.rsplit("-l", 1)[0] for entry in manifest.shards for key in entry.keys}
    records = [read_record(folder, name) for name in sorted(scenes)]
    counted = all(record is not None and record.variety for record in records)
    found = total(r.variety for r in records if r is not None) if counted else shard_histograms(folder)
    return Other(folder.resolve().name, found)


def write_account(
    settings: Settings,
    items: Sequence[Work],
    sources: Sources,
    failed: Mapping[str, Failure],
    other: Other | None = None,
    stored: Mapping[str, int] = NOTHING,
) -> int:
    """Write failures, manifest, card, tables, sheets and page from the records; return how many failures.

    Args:
        settings, items, sources: of the dataset.
        failed: scenes that this run tried in vain.
        other: another dataset to draw beside this one.
        stored: bytes of the shards in its store, by name.
    """
    output = settings.output_dir
    made = [record for item in items if (record := read_record(output, item.name, stored)) is not None]
    finished = {record.name: record.quarantined for record in made}
    failures = record_failures(output, settings, items, failed, finished)
    shards = sorted((entry for record in made for entry in record.shards), key=lambda entry: entry.name)
    manifest = Manifest(config_sha256=config_sha256(settings), shards=shards, failures=failures)
    rows = [row for record in made for row in _rows(output, record)]

    listed = source_list(settings, sources)
    write_if_changed(output / SOURCES_NAME, listed.model_dump_json(indent=1) + "\n")
    write_if_changed(output / METADATA_NAME, metadata_parquet(rows))
    sheet = contact_sheet(output, rows)
    if sheet is not None:
        write_if_changed(output / SHEET_NAME, sheet)
    own = total(record.variety for record in made)
    if own:
        write_if_changed(output / VARIETY_NAME, _variety_png(own, other))
    shown = [name for name in (SHEET_NAME, VARIETY_NAME) if (output / name).is_file()]
    refinements = [record.refinement for record in made if record.refinement is not None]
    rebuilt = [record.reconstruction for record in made if record.reconstruction is not None]
    text = card_text(settings, manifest, sources, rows, refinements, own, other, shown, listed, rebuilt)
    write_if_changed(output / CARD_NAME, text)
    links = {CARD_NAME: CARD_NAME, METADATA_NAME: METADATA_NAME} | {name: name for name in shown}
    links |= {f"{entry.name}, all members": sheet_name(entry.name) for entry in shards[:MOST_LINKS]}
    write_if_changed(output / PAGE_NAME, index_page("TRON dataset", rows, links))
    manifest.save(output)
    return failures


MOST_LINKS = 12
"""Shards whose sheets the page links; the others lie beside them in previews/."""


def _rows(output: Path, record: Record) -> list[ClipRow]:
    return record.clips or [row for entry in record.shards for row in rows_of_shard(output, entry)]


def _variety_png(own: Histograms, other: Other | None) -> bytes:
    named = {"this dataset": own} | ({other.name: other.histograms} if other else {})
    return histograms_png(
        [
            Histogram(
                measure.title,
                measure.edges,
                {label: counts[name] for label, counts in named.items() if name in counts},
                measure.logarithmic,
            )
            for name, measure in MEASURES.items()
        ],
        list(named),
    )
