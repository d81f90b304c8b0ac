"""The user's files for scenes, catalogued before any render, and their list by split.

The list, sources.json, depends on the settings and the files alone: all parts of one dataset have the same.
Two datasets are disjoint if, by hash, no mesh, texture, map or scene of one was trained on in the other.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from datagen.files.assets import Asset, Refused, find_environments, find_models
from datagen.files.checklist import Filled, StandIns, filled, read_checklist
from datagen.files.contents import Content, compared
from datagen.files.texture_sets import TextureSet, find_texture_sets
from datagen.settings.command import Settings, Split
from datagen.world.lights import HdriSpec
from tron.errors import TronError

log = logging.getLogger(__name__)

SOURCES_NAME = "sources.json"
LARGEST = 256 * 2**20
TRAINED: tuple[Split, ...] = ("train", "train_b", "validation")
"""Splits that decide what a network becomes."""
HELD_OUT = 4
"""Every fourth model, texture set or map of a folder is the test split's alone, where there are as many."""

PLACE = ("name", "split", "index", "seed")
"""Keys of a specification that say a scene's place, nothing of the scene."""

Kind = Literal["model", "texture set", "map"]
Item = TypeVar("Item")


@dataclass(frozen=True)
class Sources:
    """The user's files that scenes draw from; empty where everything is procedural.

    Attributes:
        assets: models.
        maps: files of the environments.
        environments: lights of these maps.
        refused: models that were left out because they cannot be used.
    """

    assets: tuple[Asset, ...] = ()
    maps: tuple[Asset, ...] = ()
    environments: tuple[HdriSpec, ...] = ()
    textures: tuple[TextureSet, ...] = ()
    refused: tuple[Refused, ...] = ()


def find_sources(settings: Settings) -> Sources:
    """Catalogue the user's assets and environments before any render; raises as ``datagen.files.assets``."""
    allowed = settings.allow_unlicensed
    assets, refused = (
        find_models(settings.assets, settings.catalogue, allowed, settings.asset_names)
        if settings.assets
        else ([], [])
    )
    maps, environments = (
        find_environments(settings.environments, settings.catalogue, allowed)
        if settings.environments
        else ([], [])
    )
    textures = find_texture_sets(settings.textures, settings.catalogue, allowed) if settings.textures else []
    return Sources(
        assets=tuple(assets),
        maps=tuple(maps),
        environments=tuple(environments),
        textures=tuple(textures),
        refused=tuple(refused),
    )


class Source(BaseModel):
    """One of the user's models, texture sets or maps.

    Attributes:
        splits: splits that may draw it.
        files: all its files, textures of a model too.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Kind
    id: str
    path: str
    sha256: str
    licence: str | None
    author: str | None
    source: str | None
    splits: tuple[Split, ...]
    files: tuple[Content, ...]


class SourceList(BaseModel):
    """Content of sources.json.

    Attributes:
        seed: root of all procedural draws.
        splits: splits with scenes drawn from the seed; none for captures.
        stand_ins: replacements of named assets, if there is a checklist.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[1] = 1
    seed: int
    splits: tuple[Split, ...]
    sources: tuple[Source, ...]
    stand_ins: StandIns | None = None


def slots(settings: Settings, sources: Sources) -> Filled | None:
    """Compare the settings' checklist with their files; None without one; TronError if it is unreadable."""
    if settings.checklist is None:
        return None
    return filled(read_checklist(settings.checklist), sources.maps, sources.assets)


def require_slots(settings: Settings, sources: Sources) -> Sources:
    """Return the sources without maps outside the checklist."""
    found = slots(settings, sources)
    if found is None:
        return sources
    named = {asset.path for asset in found.present} if found.checklist.maps else None
    if named is None or len(named) == len(sources.maps):
        return sources
    log.info("%d maps that the checklist does not name are left out", len(sources.maps) - len(named))
    kept = [asset.path in named for asset in sources.maps]
    return replace(
        sources,
        maps=tuple(asset for asset, keep in zip(sources.maps, kept) if keep),
        environments=tuple(light for light, keep in zip(sources.environments, kept) if keep),
    )


def tell_stand_ins(settings: Settings, sources: Sources) -> None:
    """Warn of empty slots of the checklist, which procedural assets fill."""
    found = slots(settings, sources)
    if found is not None and (found.missing or found.model_share < 1):
        log.warning("%s mode=plan lists them", found.stand_ins().sentence)


def of_split(settings: Settings, sources: Sources, split: str) -> Sources:
    """Return the sources of a split: test files are for the test split only, unless they are shared."""
    assets, textures, maps = sources.assets, sources.textures, sources.maps
    if not settings.share_models:
        assets = for_split(assets, split, Asset.hashes)
        textures = for_split(textures, split, _of_set)
    if not settings.share_maps:
        maps = for_split(maps, split, Asset.hashes)
    paths = {asset.path for asset in maps}
    return replace(
        sources,
        assets=tuple(assets),
        textures=tuple(textures),
        maps=tuple(maps),
        environments=tuple(light for light in sources.environments if light.path in paths),
    )


def tell_shared(settings: Settings, sources: Sources) -> None:
    """Log the kinds of files that training and test share, because there are too few to hold some out."""
    used = settings.used_splits()
    if "test" not in used or used == ["test"]:
        return
    for kind, found, shared in (
        ("models", sources.assets, settings.share_models),
        ("texture sets", [each.asset for each in sources.textures], settings.share_models),
        ("maps", sources.maps, settings.share_maps),
    ):
        if found and not shared and not separable(found, Asset.hashes):
            log.info(
                "%d %s are too few to hold some out of training, or copies of one another: every split has "
                "them all; with %d different ones every fourth is the test split's",
                len(found),
                kind,
                HELD_OUT,
            )


def source_list(settings: Settings, sources: Sources) -> SourceList:
    """Return the files of a dataset, each with its splits."""
    used = settings.used_splits()
    served = {split: of_split(settings, sources, split) for split in used}

    def listed(kind: Kind, asset: Asset, name: str) -> Source:
        return Source(
            kind=kind,
            id=asset.id,
            path=asset.path,
            sha256=asset.sha256,
            licence=asset.licence,
            author=asset.author,
            source=asset.source,
            splits=tuple(split for split in used if asset.id in _ids(getattr(served[split], name))),
            files=asset.contents,
        )

    found = [
        *(listed("model", each, "assets") for each in sources.assets),
        *(listed("texture set", each.asset, "textures") for each in sources.textures),
        *(listed("map", each, "maps") for each in sources.maps),
    ]
    checked = slots(settings, sources)
    return SourceList(
        seed=settings.seed,
        splits=tuple(split for split in used if settings.split(split).scenes),
        sources=tuple(found),
        stand_ins=None if checked is None else checked.stand_ins(),
    )


def read_source_list(folder: Path) -> SourceList:
    """Read the source list of a dataset.

    Raises:
        TronError: there is none, or it is damaged.
    """
    path = folder / SOURCES_NAME
    if not path.is_file():
        raise TronError(
            f"dataset has no {SOURCES_NAME}",
            folder,
            "run its tron-datagen command again: nothing is rendered, the list is written",
        )
    try:
        if path.stat().st_size > LARGEST:
            raise ValueError("file is too large")
        return SourceList.model_validate_json(path.read_bytes())
    except (OSError, ValueError, ValidationError) as error:
        raise TronError(f"{SOURCES_NAME} is damaged", path, "make the dataset's account again") from error


def _of_set(texture_set: TextureSet) -> frozenset[str]:
    return texture_set.asset.hashes()


def _ids(found: Sequence[Asset | TextureSet]) -> set[str]:
    return {each.asset.id if isinstance(each, TextureSet) else each.id for each in found}


def families(contents: Sequence[Collection[str]]) -> np.ndarray:
    """Return the family number of each asset, from 0 in the order of first members, (N,) int.

    Two assets are in one family if they share a hash, or each shares one with a third: copies under other
    names, and models with a common texture.

    Args:
        contents: the hashes of each asset.
    """
    hashes = {digest: k for k, digest in enumerate(dict.fromkeys(h for each in contents for h in each))}
    rows = [i for i, each in enumerate(contents) for _ in each]
    columns = [len(contents) + hashes[h] for each in contents for h in each]
    size = len(contents) + len(hashes)
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(size, size))
    labels = connected_components(graph, directed=False)[1][: len(contents)]
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


def for_split(items: Sequence[Item], split: str, hashes: Callable[[Item], Collection[str]]) -> list[Item]:
    """Return a split's assets: one in HELD_OUT families is for the test split; if too few, all are shared.

    Validation uses the assets of training: holding out more would reduce training.

    Args:
        items: in an order that does not depend on the machine.
        split: name of the split.
        hashes: function that returns the hashes of an asset.
    """
    if not separable(items, hashes):
        return list(items)
    numbers = families([hashes(item) for item in items])
    return [item for item, k in zip(items, numbers) if (k % HELD_OUT == HELD_OUT - 1) == (split == "test")]


def separable(items: Sequence[Item], hashes: Callable[[Item], Collection[str]]) -> bool:
    """Whether there are enough families to hold some out."""
    return len(items) > 0 and int(families([hashes(item) for item in items]).max()) + 1 >= HELD_OUT


def require_disjoint(settings: Settings, sources: Sources) -> None:
    """Require that nothing of a dataset was trained on in datasets that it must be disjoint from.

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
    """Yield a line for each source and split shared with the training splits of ``other``."""
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
    """Yield a line for each scene with the same specification as a training scene of the other dataset."""
    own = dict(_scenes(output))
    for folder in others:
        trained = dict(_scenes(folder, TRAINED))
        for digest, name in own.items():
            if digest in trained:
                yield f"scenes/{name}: is trained on in {folder.name}, as {trained[digest]}"


def _scenes(folder: Path, splits: Collection[str] | None = None) -> Iterator[tuple[str, str]]:
    """Yield hash (of the specification without PLACE) and name of each scene."""
    for path in sorted(folder.glob("scenes/*/spec.json")):
        try:
            spec = json.loads(path.read_bytes())
            split = spec.get("split")
        except (OSError, ValueError, AttributeError, RecursionError) as error:
            raise TronError("specification cannot be read", path) from error
        if splits is None or split in splits:
            text = json.dumps({key: value for key, value in spec.items() if key not in PLACE}, sort_keys=True)
            yield hashlib.sha256(text.encode()).hexdigest(), path.parent.name


def ready_sources(settings: Settings) -> Sources:
    """Catalogue the user's files before any render.

    Raises:
        TronError: as ``datagen.files.assets`` does; a checklist that cannot be read; something that a dataset
            of ``disjoint_from`` trains on.
    """
    sources = require_slots(settings, find_sources(settings))
    tell_shared(settings, sources)
    require_disjoint(settings, sources)
    return sources
