"""mode=publish: a finished dataset as a folder for the Hub: card, shards, index, pictures, Croissant.

Card and metadata.parquet are copied; files for the maker (scenes, records, logs, the resolved configuration
with its paths) are left out. Shards are linked if both folders are on one file system. croissant.json is in
the format of MLCommons' Croissant 1.0: shards and table as files with their hashes, a record a clip from the
table's columns, and a record a picture from the tars.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import yaml

from datagen.dataset.pages import COLUMNS, METADATA_NAME
from datagen.dataset.records import CONFIG_NAME
from datagen.run.account import ACCOUNT, CARD_NAME
from datagen.run.merge import link
from datagen.settings.command import Settings
from tron.errors import TronError
from tron.shards.index import index_name
from tron.shards.manifest import MANIFEST_NAME, Manifest
from tron.shards.reader import verify
from tron.shards.schema import MEMBERS
from tron.storage import sha256, write_atomic

log = logging.getLogger(__name__)

CROISSANT_NAME = "croissant.json"
_FRONT = re.compile(r"\A---\n(.*?\n)---\n", re.DOTALL)
_FORMATS = {"exr": "image/x-exr", "png": "image/png"}
_TYPES = {"string": "sc:Text", "double": "sc:Float", "int32": "sc:Integer"}
_CONTEXT = {
    "@language": "en", "@vocab": "https://schema.org/", "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/", "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/", "conformsTo": "dct:conformsTo", "citeAs": "cr:citeAs",
    "column": "cr:column", "data": {"@id": "cr:data", "@type": "@json"},
    "dataBiases": "cr:dataBiases", "dataCollection": "cr:dataCollection",
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"}, "extract": "cr:extract", "field": "cr:field",
    "fileObject": "cr:fileObject", "fileProperty": "cr:fileProperty", "fileSet": "cr:fileSet",
    "format": "cr:format", "includes": "cr:includes", "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath", "key": "cr:key", "md5": "cr:md5", "parentField": "cr:parentField",
    "path": "cr:path", "personalSensitiveInformation": "cr:personalSensitiveInformation",
    "recordSet": "cr:recordSet", "references": "cr:references", "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace", "separator": "cr:separator", "source": "cr:source", "subField": "cr:subField",
    "transform": "cr:transform",
}  # fmt: skip
"""The context that Croissant 1.0 prescribes (MLCommons, Croissant format specification, appendix)."""


def publish(settings: Settings) -> None:
    """Make the folder ``publish`` of the dataset in output_dir.

    Raises:
        TronError: no folder to make, no dataset, damaged shards, or a licence that nobody stated.
    """
    folder, target = settings.output_dir, settings.publish
    if target is None:
        raise TronError("mode=publish has no folder to make", mend="give publish=FOLDER")
    if target.resolve() == folder.resolve():
        raise TronError("publish is the dataset itself", target, "give another folder")
    manifest = Manifest.load(folder)
    described, body = _card(folder / CARD_NAME)
    licence = settings.licence or described.get("license")
    if licence in (None, "unknown"):
        mend = "give licence=cc-by-4.0 or another, by the Hub's names; the scenes' maker says which"
        raise TronError("the dataset has no licence", folder, mend)
    if problems := verify(folder):
        mend = f"tron-datagen output_dir={folder} mode=validate lists all"
        raise TronError(f"{len(problems)} problems, such as {problems[0]}", folder, mend)
    table = pq.read_table(folder / METADATA_NAME, columns=["thumbnail"])
    names = [name for name in ACCOUNT if name not in (CARD_NAME, CONFIG_NAME, MANIFEST_NAME)]
    names += [name for entry in manifest.shards for name in (entry.name, index_name(entry.name))]
    names += sorted(set(table["thumbnail"].to_pylist()) - {None})
    previews = sorted(path for path in (folder / "previews").rglob("*") if path.is_file())
    names += [str(path.relative_to(folder)) for path in previews]
    for name in dict.fromkeys([*names, MANIFEST_NAME]):
        if (folder / name).is_file():
            link(folder / name, target / name)
    described["license"] = licence
    front = yaml.safe_dump(described, sort_keys=False, allow_unicode=True)
    write_atomic(target / CARD_NAME, f"---\n{front}---\n{body}")
    content = croissant(folder, manifest, described)
    write_atomic(target / CROISSANT_NAME, json.dumps(content, indent=1) + "\n")
    clips = sum(entry.samples for entry in manifest.shards)
    size = sum(entry.bytes for entry in manifest.shards) / 1e9
    log.info("%d clips, %.3g GB: %s; huggingface-cli upload-large-folder NAME %s --repo-type=dataset",
             clips, size, target, target)  # fmt: skip


def croissant(folder: Path, manifest: Manifest, described: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON-LD of a dataset: its files, a record per clip, and a record per picture.

    Args:
        folder: the dataset. manifest: its manifest. described: front matter of its card.
    """
    table, licence = folder / METADATA_NAME, described["license"]
    shards = [
        {
            "@type": "cr:FileObject", "@id": entry.name, "name": entry.name, "contentUrl": entry.name,
            "contentSize": f"{entry.bytes} B", "encodingFormat": "application/x-tar", "sha256": entry.sha256,
            "description": f"{entry.samples} clips of {entry.split}, in WebDataset's layout",
        }
        for entry in manifest.shards
    ]  # fmt: skip
    index = {
        "@type": "cr:FileObject", "@id": METADATA_NAME, "name": METADATA_NAME, "contentUrl": METADATA_NAME,
        "encodingFormat": "application/x-parquet", "sha256": sha256(table), "description": "a row a clip",
    }  # fmt: skip
    fields = [
        {
            "@type": "cr:Field", "@id": f"clips/{column.name}", "name": f"clips/{column.name}",
            "dataType": _TYPES[str(column.type)],
            "source": {"fileObject": {"@id": METADATA_NAME}, "extract": {"column": column.name}},
        }
        for column in COLUMNS
    ]  # fmt: skip
    pictures = [
        {
            "@type": "cr:FileSet", "@id": name, "name": name, "includes": f"*.{name}.{member.extension}",
            "containedIn": [{"@id": entry.name} for entry in manifest.shards],
            "encodingFormat": _FORMATS[member.extension],
            "description": f"{member.meaning}; colours: {member.color_space or 'none'}",
        }
        for name, member in MEMBERS.items() if member.clips == "all"
    ]  # fmt: skip
    frames = [
        {
            "@type": "cr:RecordSet", "@id": f"{each['@id']}_frames", "name": f"{each['@id']}_frames",
            "description": f"a record a frame: {each['description']}",
            "field": [
                {"@type": "cr:Field", "@id": f"{each['@id']}_frames/{what}",
                 "name": f"{each['@id']}_frames/{what}", "dataType": kind,
                 "source": {"fileSet": {"@id": each["@id"]}, "extract": {"fileProperty": what}}}
                for what, kind in (("filename", "sc:Text"), ("content", "sc:Text"))
            ],
        }
        for each in pictures
    ]  # fmt: skip
    return {
        "@context": _CONTEXT, "@type": "sc:Dataset", "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": re.sub(r"[^A-Za-z0-9_-]+", "_", described["pretty_name"]),
        "description": "Clips of relit surfels: guidance buffers and the truth, for TRON's neural renderer.",
        "license": licence if isinstance(licence, str) else licence[0],
        "keywords": described.get("tags", []), "version": f"{manifest.schema_version}.0.0",
        "distribution": [index, *shards, *pictures],
        "recordSet": [
            {"@type": "cr:RecordSet", "@id": "clips", "name": "clips", "description": "a record a clip",
             "key": {"@id": "clips/key"}, "field": fields},
            *frames,
        ],
    }  # fmt: skip


def _card(path: Path) -> tuple[dict[str, Any], str]:
    try:
        text = path.read_text("utf-8")
        match = _FRONT.match(text)
        described = yaml.safe_load(match[1]) if match else None
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise TronError(f"card cannot be read: {error}", path, "make the dataset's account again") from error
    if match is None or not isinstance(described, dict):
        raise TronError("card has no front matter", path, "make the dataset's account again")
    return described, text[match.end() :]
