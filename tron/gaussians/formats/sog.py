"""PlayCanvas's SOG as a folder: ``meta.json`` beside its pictures, and ``lod-meta.json`` of several of them.

``meta.json`` and the pictures that it names are what a file of .sog zips. ``lod-meta.json``, of SOG that is
streamed, has a tree whose leaves name, for each level of detail, a part of one of its files: 0 is the finest
(github.com/playcanvas/splat-transform, streamed SOG). All that is named must lie in the folder.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tron.errors import TronError
from tron.gaussians.fields import FIELDS
from tron.gaussians.formats.packed import unpacked
from tron.gaussians.formats.splats import Splats, joined, one_line
from tron.gaussians.ply import columns_in

META, LEVELS = "meta.json", "lod-meta.json"
_LARGEST = 1 << 26
"""Bytes of a JSON: those of streamed SOG have a line for some thousand splats."""
_DEEPEST = 64


def sog_file(folder: Path) -> Path | None:
    """The JSON of SOG that a folder is; None of other folders."""
    for name in (LEVELS, META):
        try:
            if _kind(_read(folder / name)) is not None:
                return folder / name
        except TronError:
            continue
    return None


def check(path: Path) -> None:
    """Raise TronError unless a file is a JSON of SOG and the files that it names are there."""
    _files(path)


def read(path: Path) -> Splats:
    """The splats of a SOG folder, of several levels the finest; up is not stated.

    Raises:
        TronError: no JSON of SOG, files that are missing or damaged, or that lie elsewhere.
    """
    tree, files = _files(path)
    if _kind(tree) == META:
        return _splats(path)
    with one_line(path):
        parts: list[Splats] = []
        pieces = sorted(_finest(tree["tree"], 0))
        for number, file in enumerate(files):
            own = [piece[1:] for piece in pieces if piece[0] == number]
            if own or file == _environment(tree, path):
                parts += _cut(_splats(file), own, file)
        return joined(parts, None)


def _cut(splats: Splats, pieces: list[tuple[int, int]], file: Path) -> list[Splats]:
    """Parts (offset, count) of the splats; all of them where there is none."""
    count = len(splats.means)
    if any(offset < 0 or size < 0 or offset + size > count for offset, size in pieces):
        raise TronError(f"{LEVELS} names splats that the file does not have", file, "export it again")
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    spans = [slice(offset, offset + size) for offset, size in pieces] or [slice(None)]
    return [Splats(*(getattr(splats, name)[span] for name in names)) for span in spans]


def _finest(node: dict[str, Any], depth: int) -> Iterator[tuple[int, int, int]]:
    """File, offset and count of each leaf's finest level."""
    if depth > _DEEPEST:
        raise TronError(f"its tree is more than {_DEEPEST} deep")
    if levels := node.get("lods"):
        finest = levels[min(levels, key=int)]
        yield int(finest["file"]), int(finest["offset"]), int(finest["count"])
    for child in node.get("children") or ():
        yield from _finest(child, depth + 1)


def _splats(path: Path) -> Splats:
    """Of a ``meta.json`` with its pictures, or of a file of .sog."""
    content = path.read_bytes() if path.suffix.lower() == ".sog" else _zipped(path)
    with one_line(path):
        columns, _ = columns_in(unpacked(content, "sog", path), path)

        def stack(names: list[str]) -> np.ndarray:
            return np.stack([columns[name] for name in names], axis=-1)

        rest = sorted(
            (name for name in columns if name.startswith("f_rest_")), key=lambda each: int(each[7:])
        )
        sh = stack(list(FIELDS["sh"].properties))[:, None]
        if rest:
            more = stack(rest).reshape(len(sh), 3, -1).transpose(0, 2, 1)
            sh = np.concatenate([sh, more], axis=1)
        return Splats(
            means=stack(list(FIELDS["means"].properties)),
            quats=stack(list(FIELDS["quats"].properties)),
            log_scales=stack([f"scale_{k}" for k in range(3)]),
            opacity_logits=columns["opacity"],
            sh=sh,
        )


def _zipped(path: Path) -> bytes:
    """A ``meta.json`` and its pictures as a file of .sog."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        for each in (path, *_files(path)[1]):
            file.writestr(META if each == path else each.name, each.read_bytes())
    return content.getvalue()


def _files(path: Path) -> tuple[dict[str, Any], list[Path]]:
    """The JSON, and the files that it names."""
    tree = _read(path)
    kind = _kind(tree)
    if kind is None:
        raise TronError(f"this JSON is not SOG's {META} or {LEVELS}", path, "give a file of splats")
    with one_line(path):
        if kind == META:
            groups = [each for each in tree.values() if isinstance(each, dict) and "files" in each]
            names = [name for group in groups for name in group["files"]]
        else:
            names = [*tree["filenames"], *([tree["environment"]] if tree.get("environment") else [])]
        files = [_inside(path.parent, name) for name in names]
    if kind == LEVELS:
        for each in files:
            if each.suffix.lower() != ".sog" and _kind(_read(each)) != META:
                raise TronError("not SOG", each, f"{path} names it: export it again")
    return tree, files


def _environment(tree: dict[str, Any], path: Path) -> Path | None:
    return _inside(path.parent, tree["environment"]) if tree.get("environment") else None


def _inside(folder: Path, name: object) -> Path:
    """A file that a JSON names, which must lie in its folder."""
    path = folder / str(name)
    if not path.resolve().is_relative_to(folder.resolve()):
        raise TronError(f"names '{str(name)[:60]}', outside of its folder")
    if not path.is_file():
        raise TronError("a file of this SOG is missing", path, "copy the whole folder")
    return path


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _LARGEST:
            raise TronError("too large for a JSON of SOG", path)
        tree = json.loads(path.read_bytes())
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    except (ValueError, RecursionError) as error:
        raise TronError("not a readable JSON", path, "copy or export it again") from error
    return tree if isinstance(tree, dict) else {}


def _kind(tree: dict[str, Any]) -> str | None:
    if {"filenames", "tree"} <= tree.keys():
        return LEVELS
    return META if {"means", "quats", "sh0", "scales"} <= tree.keys() else None
