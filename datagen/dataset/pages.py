"""The two pages of a dataset: its card, README.md, and index.html, which shows every clip.

The card lists contents, licences, versions and the exact command. Its sentences are in ``page/card.md.j2``;
``page/card.SOURCE.md.j2`` adds the sentences of a source.

By its front matter and metadata.parquet the Hugging Face Hub, `datasets` and pandas read a dataset; shards
are webdataset tars already. `datasets` takes the columns of a whole configuration from the first clips of one
split, so splits whose clips hold other members or another number of frames are configurations of their own.
"""

from __future__ import annotations

import io
import json
import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from string import Template
from typing import Any, get_args

import jinja2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml

import tron
from datagen.dataset.clip_preview import CODES, LOG2_RANGE
from datagen.dataset.records import ClipRow, Figures, Record
from datagen.dataset.variety import MEASURES, Histograms, median
from datagen.files.sources import SourceList, Sources
from datagen.settings.command import RELIT, SHARD_SPLITS, Settings
from datagen.settings.command_line import command_line
from tron.color import AGX_INSET, AGX_LOG2_RANGE, agx
from tron.runtime import describe_machine
from tron.shards.manifest import Manifest
from tron.shards.schema import SCHEMA_VERSION

AGX_SAMPLES = 1024
"""Intervals of the table of AgX's curve; between them the page interpolates, to 1e-5."""
PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "OpenEXR")


def card_text(
    settings: Settings,
    manifest: Manifest,
    sources: Sources,
    listed: SourceList,
    made: Sequence[Record],
    compared: Mapping[str, Histograms],
    pictures: Sequence[str],
) -> str:
    """Return README.md, the same bytes for the same dataset.

    Args:
        settings: settings of the dataset.
        manifest: manifest of the dataset.
        sources: the user's files it drew from.
        listed: the user's files by split.
        made: records of its scenes.
        compared: dataset name -> histograms, its own first; empty if it has none.
        pictures: files beside the card that it shows.
    """
    rows = [row for record in made for row in record.clips]
    by_split = {split: [row for row in rows if row.split == split] for split in SHARD_SPLITS}
    clips = {split: len(found) for split, found in by_split.items() if found}
    files = (*sources.assets, *sources.maps, *(each.asset for each in sources.textures))
    packages = describe_machine()["packages"]
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("datagen.dataset", "page"),
        autoescape=False,
        trim_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["cell"] = _cell
    return environment.get_template(f"card.{settings.source}.md.j2").render(
        settings=settings,
        manifest=manifest,
        sources=sources,
        listed=listed,
        pictures=pictures,
        clips=clips,
        files=files,
        front_matter=front_matter(settings, clips, [file.licence for file in files]),
        version=tron.__version__,
        schema=SCHEMA_VERSION,
        splits=[_split_row(split, by_split[split], settings) for split in clips],
        command=command_line(settings, "DIR", machine=False),
        made_of=_made_of(settings),
        refined=_refined(made),
        rebuilt=_rebuilt([each.reconstruction for each in made if each.reconstruction is not None]),
        packages={name: packages[name] for name in PACKAGES if name in packages},
        variety=_medians(list(compared.values())),
        compared=list(compared),
        configurations=[each["config_name"] for each in configurations(settings, clips)][1:],
        relit=any(split.endswith(RELIT) for split in clips),
        scenes=len({row.scene for row in rows}),
    )


def _split_row(split: str, found: Sequence[ClipRow], settings: Settings) -> list[Any]:
    """Cells of the table of splits."""
    recipe, families = settings.split(split), Counter(row.light_family for row in found)
    styles = Counter({row.scene: row.style for row in found}.values())
    kinds = ", ".join(f"{count} {style}" for style, count in sorted(styles.items()))
    return [
        split,
        styles.total(),
        len(found),
        sum(row.frames for row in found),
        f"{recipe.width} x {recipe.height}",
        ", ".join(f"{count} {family}" for family, count in sorted(families.items())),
        kinds if len(styles) > 1 else next(iter(styles)),
    ]


def _made_of(settings: Settings) -> str:
    """Return approximate numbers of surfels per scene and of their views, over all splits with scenes."""
    budgets = [each for split in settings.used_splits() for each in settings.surfel_budgets(split)]

    def between(numbers: Sequence[int]) -> str:
        return " to ".join(f"{number:,}" for number in sorted({min(numbers), max(numbers)}))

    surfels, views = between([each.surfels for each in budgets]), between([each.views for each in budgets])
    return f"about {surfels} surfels a scene, from {views} views"


def _refined(made: Sequence[Record]) -> dict[str, Any] | None:
    """Return the gain of fitting surfels to their G-buffers, means over scenes."""
    found = [record.refinement for record in made if record.refinement is not None]
    if not found:
        return None

    def means(when: str) -> list[float]:
        names = Figures.model_fields
        return [statistics.fmean(getattr(getattr(each, when), name) for each in found) for name in names]

    steps = sorted({min(each.steps for each in found), max(each.steps for each in found)})
    return {"steps": " to ".join(map(str, steps)), "before": means("before"), "after": means("after")}


def _rebuilt(found: Sequence[Figures]) -> dict[str, Any] | None:
    """Return the errors of reconstructed surfels, medians over scenes."""
    if not found:
        return None
    psnr, degrees = (
        [getattr(each, name) for each in found] for name in ("base_color_psnr", "normal_mae_deg")
    )
    return {"count": len(found), "psnr": statistics.median(psnr), "degrees": statistics.median(degrees)}


def _medians(found: Sequence[Histograms]) -> list[list[str]]:
    """Return rows of the table of histograms: title, one median per dataset, counted items."""
    rows = []
    for name, measure in MEASURES.items():
        values = [median(name, each.get(name, ())) for each in found]
        medians = ["" if math.isnan(value) else f"{value:.3g}" for value in values]
        if any(medians):
            rows.append([measure.title, *medians, measure.counted])
    return rows


def _cell(text: str) -> str:
    """Escape text for a cell of a Markdown table."""
    return text.replace("|", "\\|")


def index_page(title: str, rows: Sequence[ClipRow], links: Mapping[str, str]) -> str:
    """Return index.html, the same bytes for the same clips.

    Args:
        title: title of the page.
        rows: the clips, in their initial order.
        links: name -> file beside the page.
    """
    folder = resources.files("datagen.dataset") / "page"
    read = {name: folder.joinpath(f"index.{name}").read_text("utf-8") for name in ("html", "css", "js")}
    data = {"clips": [row.model_dump(mode="json") for row in rows], "tone": tone_tables()}
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    return Template(read["html"]).substitute(
        title=escape(title),
        style=read["css"],
        links=" · ".join(f'<a href="{escape(file)}">{escape(name)}</a>' for name, file in links.items()),
        data=text,
        script=read["js"],
    )


def tone_tables() -> dict[str, Any]:
    """Return tables for the page's display values: AgX of ``tron.color``, and the code of previews."""
    stops = np.linspace(*AGX_LOG2_RANGE, AGX_SAMPLES + 1)
    curve = agx(np.repeat(2.0 ** stops[:, None], 3, axis=1))[:, 0]  # a grey is the same after the inset
    return {
        "agx_inset": AGX_INSET,
        "agx_range": AGX_LOG2_RANGE,
        "agx": [round(float(value), 6) for value in curve],
        "log2_range": LOG2_RANGE,
        "codes": CODES,
    }


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

ARROW = {str: pa.string(), float: pa.float64(), int: pa.int32()}
COLUMNS = pa.schema(
    [
        pa.field(name, ARROW[next(iter(get_args(field.annotation)), field.annotation)])
        for name, field in ClipRow.model_fields.items()
    ]
)
"""Columns of metadata.parquet, those of :class:`datagen.dataset.records.ClipRow`."""


def metadata_parquet(rows: Sequence[ClipRow]) -> bytes:
    """Return metadata.parquet with one row per clip, the same bytes for the same rows."""
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist([row.model_dump() for row in rows], COLUMNS), buffer)
    return buffer.getvalue()


def front_matter(settings: Settings, clips: Mapping[str, int], licences: Sequence[str | None]) -> str:
    """Return the YAML front matter of README.md.

    Args:
        settings: settings of the dataset.
        clips: number of clips by split.
        licences: licences of the source files; None for a file without one.
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
    """Group splits whose clips have the same files into configurations; the first is the default."""
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
    """Return the Hub's names of licences, one or several; "unknown" without files of others.

    The maker of a dataset of procedural scenes chooses its licence before publishing.
    """
    words = {"-".join((licence or "").lower().split()) for licence in licences}
    names = sorted({SHORT.get(word, word if word in LICENCES else "other") for word in words})
    return "unknown" if not names else names[0] if len(names) == 1 else names


def size_category(clips: int) -> str:
    """Return the Hub's size category for a number of clips.

    >>> size_category(112), size_category(39_000)
    ('n<1K', '10K<n<100K')
    """
    bounds = ["1K", "10K", "100K", "1M", "10M", "100M", "1B"]
    for number, (bound, top) in enumerate(zip(bounds, (10**k for k in range(3, 10)))):
        if clips < top:
            return f"{bounds[number - 1]}<n<{bound}" if number else f"n<{bound}"
    return "n>1B"
