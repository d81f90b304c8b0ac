"""The dataset card: what is in the folder, under which licences, made by what, and by which exact command."""

from __future__ import annotations

import json
import math
import shlex
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, cast

from omegaconf import OmegaConf

import tron
from datagen.assets import Asset
from datagen.captured_settings import CapturedSettings
from datagen.clip_rows import ClipRow
from datagen.contact_sheet import SHEET_NAME
from datagen.hub import configurations, front_matter
from datagen.plan import Figures, Refinement, Sources, config_sha256
from datagen.settings import OUTSIDE, RELIT, SHARD_SPLITS, Settings
from datagen.source_list import SOURCES_NAME, SourceList
from datagen.variety import MEASURES, VARIETY_NAME, Histograms, Other, median
from tron.cli.recipes import complete, compose_recipe, group_options
from tron.nested import leaves
from tron.runtime import describe_machine
from tron.shards.manifest import Manifest
from tron.shards.schema import SCHEMA_VERSION

PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "OpenEXR")


def command_line(settings: Settings, output_dir: str, only: Sequence[str] = (), machine: bool = True) -> str:
    """The command that makes a dataset: every key that differs from the shipped configuration, in full.

    It does not lean on recipes, whose content may change. ``output_dir`` and ``only`` are the caller's;
    without ``machine`` it leaves out what decides nothing of the content: cluster and workers.
    """
    groups = _prior_group(settings)
    recipe = compose_recipe("conf.datagen", Settings, groups)
    values = settings.model_dump(mode="json") | {"output_dir": output_dir, "only": list(only)}
    if settings.source == "captured":
        recipe = complete(recipe)
        for part in ("reconstruction", "light"):
            values["captured"][part]["seed"] = "${seed}"  # as it is shipped: each capture has its own
    shipped = cast(dict, OmegaConf.to_container(recipe, resolve=False))
    if settings.source == "synthetic":
        values["captured"] = shipped["captured"]
    if not machine:
        values = {key: value for key, value in values.items() if key not in OUTSIDE}
        values |= {"output_dir": output_dir}
    defaults, wanted = leaves(shipped), leaves(values)
    parents = {key.rsplit(".", 1)[0] for key in defaults if "." in key}
    folded, words = _folded(wanted, defaults), ["tron-datagen", *groups]
    for key, value in folded.items():
        if key not in defaults and key not in parents:
            words.append(f"+{key}={_hydra(value)}")
        elif defaults.get(key, ...) != value:
            words.append(f"{key}={_hydra(value)}")
    # A cluster of another kind has other options: those of the shipped one must go.
    inside = {key.rsplit(".", 1)[0] for key in wanted if "." in key}
    words += [f"~{key}" for key in defaults if key not in folded and key.rsplit(".", 1)[0] in inside]
    return " ".join(shlex.quote(word) for word in words)


def _prior_group(settings: Settings) -> list[str]:
    """The override that chooses the prior of captures, where it is a shipped one and not the default."""
    if settings.source == "synthetic":
        return []
    target = settings.captured.prior["_target_"]
    if target == CapturedSettings().prior["_target_"]:
        return []
    for name in group_options("conf.datagen")["prior"]:
        shipped = compose_recipe("conf.datagen", Settings, [f"prior={name}"])
        if shipped.captured.prior["_target_"] == target:
            return [f"prior={name}"]
    return []


def _folded(wanted: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The leaves; a mapping in a plain value's place stays whole, for nothing can be added under that."""
    folded: dict[str, Any] = {}
    for key, value in wanted.items():
        parent, _, name = key.rpartition(".")
        if defaults.get(parent) is not None:
            folded.setdefault(parent, {})[name] = value
        else:
            folded[key] = value
    return folded


def _hydra(value: Any) -> str:
    """A value in the grammar of Hydra's overrides."""
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{name}:{_hydra(item)}" for name, item in value.items()) + "}"
    if isinstance(value, str):
        plain = value != "" and all(c.isalnum() or c in "_-./" for c in value)
        return value if plain else json.dumps(value)
    if isinstance(value, list):
        return "[" + ",".join(_hydra(item) for item in value) + "]"
    return json.dumps(value)


def card_text(
    settings: Settings,
    manifest: Manifest,
    sources: Sources,
    rows: Sequence[ClipRow],
    refinements: Sequence[Refinement] = (),
    variety: Histograms | None = None,
    other: Other | None = None,
    pictures: Sequence[str] = (),
    listed: SourceList | None = None,
    reconstructed: Sequence[Figures] = (),
) -> str:
    """README.md, the same bytes for the same dataset.

    Args:
        settings: what it was made with.
        manifest: what it holds.
        sources: the user's files it drew from.
        rows: its clips.
        refinements: of the scenes' surfels, where they were refined.
        variety: its histograms.
        other: those of another dataset, drawn beside its own.
        pictures: files beside the card that it shows.
        listed: its sources by split.
        reconstructed: surfels that were reconstructed from pictures, against the truth.
    """
    by_split = {split: [row for row in rows if row.split == split] for split in SHARD_SPLITS}
    clips = {split: len(found) for split, found in by_split.items() if found}
    files = _files(sources)
    lines = [
        front_matter(settings, clips, [file.licence for file in files]),
        "# Dataset card",
        "",
        f"Clips of {settings.source} scenes for TRON's neural renderer, made by `tron-datagen` "
        f"{tron.__version__} "
        f"(shard schema {SCHEMA_VERSION}, configuration {config_sha256(settings)[:12]}).",
        "Open `index.html` to look at every clip.",
        "",
        *([f"![one frame each of its scenes]({SHEET_NAME})", ""] if SHEET_NAME in pictures else []),
        "| split | scenes | clips | frames | size | lights | style |",
        "|---|---|---|---|---|---|---|",
    ]
    for split in clips:
        found, recipe = by_split[split], settings.split(split)
        families = Counter(row.light_family for row in found)
        styles = Counter({row.scene: row.style for row in found}.values())
        kinds = ", ".join(f"{count} {style}" for style, count in sorted(styles.items()))
        lines.append(
            f"| {split} | {styles.total()} | {len(found)} | {sum(row.frames for row in found)} "
            f"| {recipe.width} x {recipe.height} "
            f"| {', '.join(f'{count} {family}' for family, count in sorted(families.items()))} "
            f"| {kinds if len(styles) > 1 else next(iter(styles))} |"
        )
    lines += [
        "",
        f"Scenes that could not be made: {manifest.failures}"
        + (" (see failures.jsonl)." if manifest.failures else "."),
        "",
        "## How it was made",
        "",
        "    " + command_line(settings, "DIR", machine=False),
        "",
        f"Root seed {settings.seed}. {_origin(settings)} "
        "`exposure` in a clip's metadata is the scalar to apply before AgX.",
        *_refinement(refinements),
        *_reconstruction(reconstructed),
        "",
        "| software | version |",
        "|---|---|",
    ]
    packages = describe_machine()["packages"]
    lines += [f"| {name} | {packages[name]} |" for name in PACKAGES if name in packages]
    lines += _variety(variety or {}, other, pictures)
    lines += _reading(settings, clips)
    lines += ["", "## What it was made from", ""]
    if listed is not None and listed.stand_ins is not None:
        lines += [listed.stand_ins.sentence, ""]
    if files := _files(sources):
        lines += ["| asset | licence | author | source | sha256 |", "|---|---|---|---|---|"]
        lines += [_asset_row(asset) for asset in files]
        lines += [
            "",
            f"`{SOURCES_NAME}` has the hash of every file, and the splits that it serves.",
            "",
        ]
    if sources.refused:
        lines += [f"Models left out because they cannot be used: {len(sources.refused)}.", ""]
        lines += ["| model | reason |", "|---|---|"]
        lines += [f"| {_cell(model.path)} | {_cell(model.reason)} |" for model in sources.refused]
        lines += [""]
    if settings.source == "captured":
        lines += _captures(rows)
        return "\n".join(lines) + "\n"
    if not sources.assets and not sources.textures:
        lines.append("Shapes and materials are procedural: no asset of anybody's is in it.")
    elif not sources.assets:
        lines.append("Shapes are procedural, materials those of the texture sets above and procedural ones.")
    if not sources.maps:
        lines.append("Lights are procedural; skies follow Mitsuba's `sunsky`.")
    return "\n".join(lines) + "\n"


def _origin(settings: Settings) -> str:
    """Origin of frames and guidance, in a sentence or two."""
    if settings.source == "synthetic":
        return (
            "Frames by Mitsuba's path tracer, guidance by TRON's surfel tracer on "
            f"about {settings.surfels:,} surfels a scene, from {settings.views} views. Buffers are linear;"
        )
    shown = "as the mean photo of their capture would show them" if settings.captured.balance else "as stored"
    values = "decoded to linear light" if settings.captured.linear else "display values"
    relit = (
        "In splits whose names end in `_relit`, guidance is of the same surfels under lights that the photos "
        "never saw, and `rgb` is what was path-traced under them, linear. "
    )
    return (
        f"Frames (`rgb`) are photos, {values}, {shown}; guidance by TRON's surfel tracer on surfels "
        "and light that were reconstructed from the same photos, `scenes/NAME/spec.json` says how well. "
        f"{relit if settings.captured.relit is not None else ''}Guidance is linear;"
    )


def _captures(rows: Sequence[ClipRow]) -> list[str]:
    """Rights in photos: nothing in the files tells them, so their owner has to."""
    scenes = {row.scene for row in rows}
    return [f"{len(scenes)} captures. Photos are their owners': say under which licence before you publish."]


def _reconstruction(found: Sequence[Figures]) -> list[str]:
    if not found:
        return []
    return [
        "",
        f"Surfels of {len(found)} scene{'s' * (len(found) > 1)} were reconstructed from path-traced "
        "pictures, as a capture's are; on views that were not among them base color reaches "
        f"{statistics.median(each.base_color_psnr for each in found):.1f} dB and normals are off by "
        f"{statistics.median(each.normal_mae_deg for each in found):.2f}° (medians). `surfels_from` in a "
        "clip's metadata says which they are, `albedo_scale` in scenes/NAME/record.json by how much their "
        "base color was scaled to the truth's.",
    ]


def _refinement(found: Sequence[Refinement]) -> list[str]:
    """Gain of fitting the surfels to their G-buffers, means over scenes."""
    if not found:
        return []
    before, after = (
        [
            sum(getattr(getattr(each, when), name) for each in found) / len(found)
            for name in Figures.model_fields
        ]
        for when in ("before", "after")
    )
    return [
        "",
        f"{found[0].steps} optimisation steps fit a scene's surfels to its G-buffers. At held-out cameras "
        f"that took base color from {before[0]:.1f} to {after[0]:.1f} dB, normals from {before[1]:.2f} to "
        f"{after[1]:.2f} degrees, and silhouettes (mean of |opacity - mask|) from {before[2]:.4f} to "
        f"{after[2]:.4f}.",
    ]


def _variety(variety: Histograms, other: Other | None, pictures: Sequence[str]) -> list[str]:
    """The figure of the histograms, and their medians as a table."""
    if not variety:
        return []
    found = {"this dataset": variety} | ({other.name: other.histograms} if other else {})
    lines = [
        "",
        "## Variety",
        "",
        "Of the first frame of every clip: materials and depth of the pixels that show a surface, as they "
        "truly are; the rest once a clip. Shadows: share of the irradiance on the surfels that they take. "
        "Bounced: share of `lit` that `shadowed` lacks. Silhouettes: lines where a surface ends before "
        "another or before nothing.",
        "",
        *([f"![histograms]({VARIETY_NAME})", ""] if VARIETY_NAME in pictures else []),
        f"| measure | {' | '.join(f'median, {_cell(name)}' for name in found)} | counted |",
        f"|---|{'---|' * len(found)}---|",
    ]
    for name, measure in MEASURES.items():
        values = [median(name, each.get(name, ())) for each in found.values()]
        medians = ["" if math.isnan(value) else f"{value:.3g}" for value in values]
        if any(medians):
            lines.append(f"| {measure.title} | {' | '.join(medians)} | {measure.counted} |")
    return lines


def _reading(settings: Settings, clips: Mapping[str, int]) -> list[str]:
    """Section for other programs: the calls that read it."""
    if not clips:
        return []
    named = [each["config_name"] for each in configurations(settings, clips)]
    split = next(iter(clips))
    lines = [
        "",
        "## Reading it",
        "",
        "```python",
        "import datasets, pandas",
        f'clips = datasets.load_dataset("DIR", split="{split}")',
        'table = pandas.read_parquet("DIR/metadata.parquet")  # a row a clip',
        "```",
        "",
    ]
    if len(named) > 1:
        others = ", ".join(f"`{name}`" for name in named[1:])
        lines += [f"Splits whose clips hold other files are configurations of their own: {others}.", ""]
    return [
        *lines,
        f"A frame's file is a column, such as `f00.rgb.exr`: OpenEXR bytes of {_values(settings, clips)}. "
        "`meta.json` holds cameras, exposure and light.",
    ]


def _values(settings: Settings, clips: Mapping[str, int]) -> str:
    """Meaning of the numbers in a frame's files, in words."""
    if settings.source == "synthetic" or settings.captured.linear:
        return "linear values"
    relit = any(split.endswith(RELIT) for split in clips)
    return "linear values, but for `rgb`: photos are display values, as `color_space` in `meta.json` says" + (
        f" (in splits whose names end in `{RELIT}` it is linear too)" if relit else ""
    )


def _files(sources: Sources) -> tuple[Asset, ...]:
    """All of the user's files that scenes draw from."""
    return (*sources.assets, *sources.maps, *(each.asset for each in sources.textures))


def _asset_row(asset: Asset) -> str:
    cells = (
        asset.id,
        asset.licence or "none stated",
        asset.author or "",
        asset.source or "",
        asset.sha256[:16],
    )
    return "| " + " | ".join(map(_cell, cells)) + " |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
