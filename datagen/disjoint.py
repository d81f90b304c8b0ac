"""Disjointness of two datasets, by hash: no mesh, texture or map of one's, and no scene, was trained on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from datagen.contents import Content, compared
from datagen.plan import Sources
from datagen.settings import Settings
from datagen.source_list import TRAINED, Source, SourceList, read_source_list, source_list
from tron.errors import TronError

PLACE = ("name", "split", "index", "seed")
"""Keys of a specification that say a scene's place, nothing of the scene."""


def require_disjoint(settings: Settings, sources: Sources) -> None:
    """Make sure that nothing of a dataset was trained on in those that it must not meet.

    Raises:
        TronError: a file of its is in what one of them trains on (named on both sides), both draw scenes of
            a split from one seed, or a folder has no list of its sources.
    """
    if not settings.disjoint_from:
        return
    own = source_list(settings, sources)
    for folder in settings.disjoint_from:
        problem = next(overlaps(own, read_source_list(folder), folder), None)
        if problem is not None:
            raise TronError(problem, folder, "leave it out, or choose another seed for scenes")


def overlaps(own: SourceList, other: SourceList, folder: Path) -> Iterator[str]:
    """Lines for what is shared with the splits that ``other`` trains on, one for each source and split."""
    there: dict[str, tuple[Source, str]] = {}
    for source in other.sources:
        if set(source.splits) & set(TRAINED):
            for each in _compared(source):
                there.setdefault(each.sha256, (source, each.path))
    for source in own.sources:
        shared = next((each for each in _compared(source) if each.sha256 in there), None)
        if source.splits and shared is not None:
            twin, path = there[shared.sha256]
            yield (
                f"{source.kind} '{source.id}' is trained on in {folder.name}: {shared.path} is {path} of "
                f"{twin.kind} '{twin.id}' there"
            )
    if own.seed == other.seed:
        for split in own.splits:
            if split in other.splits and split in TRAINED:
                yield f"scenes of {split} are those of {folder.name}: both are drawn from seed {own.seed}"


def _compared(source: Source) -> list[Content]:
    hashes = compared(source.files)
    return [each for each in source.files if each.sha256 in hashes]


def shared_scenes(output: Path, others: Sequence[Path]) -> Iterator[str]:
    """Scenes of a dataset whose specification is that of a scene another one trains on, a line each."""
    own = dict(_scenes(output))
    for folder in others:
        trained = dict(_scenes(folder, TRAINED))
        for digest, name in own.items():
            if digest in trained:
                yield f"scenes/{name}: is trained on in {folder.name}, as {trained[digest]}"


def _scenes(folder: Path, splits: Collection[str] | None = None) -> Iterator[tuple[str, str]]:
    """Hash of each scene's specification without its place, and its name."""
    for path in sorted(folder.glob("scenes/*/spec.json")):
        try:
            spec = json.loads(path.read_bytes())
            split = spec.get("split")
        except (OSError, ValueError, AttributeError, RecursionError) as error:
            raise TronError("specification cannot be read", path) from error
        if splits is None or split in splits:
            text = json.dumps({key: value for key, value in spec.items() if key not in PLACE}, sort_keys=True)
            yield hashlib.sha256(text.encode()).hexdigest(), path.parent.name
