"""Front matter and metadata.parquet: the Hugging Face Hub, `datasets` and pandas read a dataset by them.

Shards are webdataset tars already. `datasets` takes the columns of a whole configuration from the first clips
of one split, so splits whose clips hold other members or another number of frames are configurations of
their own.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import yaml

from datagen.clip_rows import ClipRow
from datagen.settings import SHARD_SPLITS, Settings

METADATA_NAME = "metadata.parquet"
LICENCES = frozenset(
    (
        *("apache-2.0", "bsd-2-clause", "bsd-3-clause", "gpl-3.0", "mit", "odbl", "pddl", "unlicense"),
        *("cc0-1.0", "cc-by-2.0", "cc-by-3.0", "cc-by-4.0", "cc-by-sa-3.0", "cc-by-sa-4.0", "cc-by-nd-4.0"),
        *("cc-by-nc-4.0", "cc-by-nc-nd-4.0", "cc-by-nc-sa-4.0"),
    )
)
"""Licences by the Hub's names, of those that models and maps come under; any other is "other" there."""

SHORT = {"cc0": "cc0-1.0", "apache2": "apache-2.0"}
"""Usual short names of some of them that leave no doubt."""

COLUMNS = pa.schema(
    [
        *(pa.field(name, pa.string()) for name in ("key", "scene", "split", "style", "light_family")),
        pa.field("contrast", pa.string()),
        pa.field("contrast_share", pa.float64()),
        pa.field("capture", pa.string()),
        pa.field("exposure", pa.float64()),
        *(pa.field(name, pa.int32()) for name in ("frames", "width", "height")),
        pa.field("shard", pa.string()),
        pa.field("thumbnail", pa.string()),
    ]
)
"""Columns of metadata.parquet, those of :class:`datagen.clip_rows.ClipRow`."""


def metadata_parquet(rows: Sequence[ClipRow]) -> bytes:
    """metadata.parquet: a row a clip, the same bytes for the same rows."""
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist([row.model_dump() for row in rows], COLUMNS), buffer)
    return buffer.getvalue()


def front_matter(settings: Settings, clips: Mapping[str, int], licences: Sequence[str | None]) -> str:
    """YAML front matter of README.md.

    Args:
        settings: what the dataset was made with.
        clips: their number by split.
        licences: of the files that it was made from; None where one has none.
    """
    described = {
        "pretty_name": "TRON relighting clips",
        "license": licence_names(licences),
        "task_categories": ["image-to-image"],
        "tags": [
            *("relighting", "inverse-rendering", "neural-rendering", "hdr", settings.source, "webdataset"),
            *("mitsuba", "gaussian-splatting"),
        ],
        "size_categories": [size_category(sum(clips.values()))],
        "configs": configurations(settings, clips),
    }
    return "---\n" + yaml.safe_dump(described, sort_keys=False, allow_unicode=True) + "---\n"


def configurations(settings: Settings, clips: Mapping[str, int]) -> list[dict[str, Any]]:
    """Splits by configuration: those whose clips hold the same files; the first is the default one."""
    kinds: dict[tuple[bool, int], list[str]] = {}
    for split in (name for name in SHARD_SPLITS if clips.get(name)):
        recipe = settings.split(split)
        kinds.setdefault((recipe.reference_buffers, recipe.frames), []).append(split)
    return [
        {
            "config_name": "_".join(splits) if number else "default",
            "data_files": [{"split": split, "path": f"{split}-*.tar"} for split in splits],
        }
        for number, splits in enumerate(kinds.values())
    ]


def licence_names(licences: Sequence[str | None]) -> str | list[str]:
    """The Hub's names of licences, one or several; "unknown" where nobody's files are in it.

    A dataset of procedural scenes is its maker's, who says before publishing under which licence.
    """
    words = {"-".join((licence or "").lower().split()) for licence in licences}
    names = sorted({SHORT.get(word, word if word in LICENCES else "other") for word in words})
    return "unknown" if not names else names[0] if len(names) == 1 else names


def size_category(clips: int) -> str:
    """The Hub's words for a number of clips.

    >>> size_category(112), size_category(39_000)
    ('n<1K', '10K<n<100K')
    """
    bounds = ["1K", "10K", "100K", "1M", "10M", "100M", "1B"]
    for number, (bound, top) in enumerate(zip(bounds, (10**k for k in range(3, 10)))):
        if clips < top:
            return f"{bounds[number - 1]}<n<{bound}" if number else f"n<{bound}"
    return "n>1B"
