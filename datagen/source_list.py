"""sources.json: the user's files that a dataset draws from, by hash and by split, for programs to read.

It depends on the settings and the files alone, so all parts of one dataset have the same.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from datagen.assets import Asset
from datagen.checklist import Filled, StandIns, filled, read_checklist
from datagen.contents import Content
from datagen.holding_out import HELD_OUT, for_split, separable
from datagen.plan import Sources
from datagen.settings import Settings, Split
from datagen.texture_sets import TextureSet
from tron.errors import TronError

log = logging.getLogger(__name__)

SOURCES_NAME = "sources.json"
LARGEST = 256 * 2**20
TRAINED: tuple[Split, ...] = ("train", "train_b", "validation")
"""Splits that decide what a network becomes."""

Kind = Literal["model", "texture set", "map"]


class Source(BaseModel):
    """One of the user's models, texture sets or maps.

    Attributes:
        splits: that may draw it.
        files: all that it was made from, textures of a model too.
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
        seed: root of what is procedural.
        splits: that have scenes drawn from it; none of captures, which are drawn from no seed.
        stand_ins: for named assets, where there is a checklist.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[1] = 1
    seed: int
    splits: tuple[Split, ...]
    sources: tuple[Source, ...]
    stand_ins: StandIns | None = None


def slots(settings: Settings, sources: Sources) -> Filled | None:
    """The checklist of the settings held against their files; None without one; TronError as reading it."""
    if settings.checklist is None:
        return None
    return filled(read_checklist(settings.checklist), sources.maps, sources.assets)


def require_slots(settings: Settings, sources: Sources) -> Sources:
    """The sources without maps that the checklist does not name."""
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
    """Warn of empty slots of the checklist, which procedural things fill."""
    found = slots(settings, sources)
    if found is not None and (found.missing or found.model_share < 1):
        log.warning("%s mode=plan lists them", found.stand_ins().sentence)


def of_split(settings: Settings, sources: Sources, split: str) -> Sources:
    """The sources that a split may draw: test files serve the test split alone, unless they are shared."""
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
    """Log which kinds of files serve training and test both, because there are too few to hold some out."""
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
    """The files that a dataset draws from, each with the splits that may."""
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
        splits=tuple(used) if settings.source == "synthetic" else (),
        sources=tuple(found),
        stand_ins=None if checked is None else checked.stand_ins(),
    )


def read_source_list(folder: Path) -> SourceList:
    """The list of a dataset.

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
