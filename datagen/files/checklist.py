"""Checklists of named assets: which ones are in the user's folders, and where to get the others.

A benchmark that names its maps and models has a slot for each. Nothing is downloaded: a slot that is empty is
filled by something procedural, and the dataset says so.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, ValidationError

from datagen.files.assets import Asset
from tron.errors import TronError

SHIPPED = "datagen.files.checklists"
LARGEST = 2**20
_SIZE = re.compile(r"_\d+k(_hdr)?$", re.IGNORECASE)


class NamedMap(BaseModel):
    """A map with a slot: its name with or without its size, its source, and its licence."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    source: str
    licence: str


class Models(BaseModel):
    """A number of slots for models of any names."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    count: NonNegativeInt = 0
    source: str = ""
    licence: str = ""


class Checklist(BaseModel):
    """Slots of a benchmark."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    title: str
    maps: list[NamedMap] = Field(default_factory=list)
    models: Models = Models()


class StandIns(BaseModel):
    """Named assets that procedural ones replace, as recorded in the dataset.

    Attributes:
        title: title of the checklist.
        empty_maps: names of missing maps.
        maps, models: numbers of slots.
        empty_models: number of missing models.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    title: str
    maps: int
    models: int
    empty_maps: tuple[str, ...]
    empty_models: int

    @property
    def sentence(self) -> str:
        """Sentence with the number of named assets that are stand-ins."""
        empty = len(self.empty_maps) + self.empty_models
        return (
            f"{empty} of {self.maps + self.models} named assets of {self.title} are procedural stand-ins "
            f"({len(self.empty_maps)} of {self.maps} maps, {self.empty_models} of {self.models} models)."
        )


@dataclass(frozen=True)
class Filled:
    """A checklist compared with the user's files.

    Attributes:
        present: available maps of the list, in its order.
        missing: missing maps.
        models: number of available models, at most the number of slots.
    """

    checklist: Checklist
    present: tuple[Asset, ...]
    missing: tuple[NamedMap, ...]
    models: int

    @property
    def map_share(self) -> float:
        """Share of the list's maps that are available."""
        slots = len(self.checklist.maps)
        return len(self.present) / slots if slots else 1.0

    @property
    def model_share(self) -> float:
        """Share of the list's models that are available."""
        return self.models / self.checklist.models.count if self.checklist.models.count else 1.0

    def stand_ins(self) -> StandIns:
        """The slots in the form that the dataset records."""
        wanted = self.checklist.models.count
        return StandIns(
            title=self.checklist.title,
            maps=len(self.checklist.maps),
            models=wanted,
            empty_maps=tuple(each.name for each in self.missing),
            empty_models=wanted - self.models,
        )

    def report(self, environments: Path | None, assets: Path | None) -> str:
        """Lines for people: numbers, and for all that is missing where to get it and where to put it."""
        wanted = self.checklist.models
        maps = str(environments) if environments is not None else "environments=FOLDER"
        models = str(assets) if assets is not None else "assets=FOLDER"
        lines = [
            f"{self.checklist.title}, maps present: {len(self.present)} of {len(self.checklist.maps)}",
            *(
                f"  missing: {each.name} ({each.source}, licence {each.licence}); put it in "
                f"{maps}/{each.name}.hdr"
                for each in self.missing
            ),
            f"{self.checklist.title}, models present: {self.models} of {wanted.count}",
        ]
        if self.models < wanted.count:
            lines.append(
                f"  missing: {wanted.count - self.models} models ({wanted.source}, licence "
                f"{wanted.licence}); put each in {models}/NAME/NAME.gltf"
            )
        if self.missing or self.models < wanted.count:
            lines.append(
                "Nothing is downloaded: state the licences in catalogue.json beside the files. "
                + self.stand_ins().sentence
            )
        return "\n".join(lines)


def read_checklist(name: str) -> Checklist:
    """A shipped checklist by its name, or a YAML file by its path.

    Raises:
        TronError: there is none, or it is damaged.
    """
    shipped = {
        Path(each.name).stem: each for each in resources.files(SHIPPED).iterdir() if each.name[-5:] == ".yaml"
    }
    path = Path(name)
    try:
        if name in shipped:
            text = shipped[name].read_text("utf-8")
        elif path.is_file() and path.stat().st_size <= LARGEST:
            text = path.read_text("utf-8")
        else:
            mend = f"give a YAML file, or one of {', '.join(sorted(shipped))}"
            raise TronError("checklist not found", name, mend)
        return Checklist.model_validate(yaml.safe_load(text))
    except (OSError, ValueError, RecursionError, yaml.YAMLError, ValidationError) as error:
        raise TronError(
            f"checklist cannot be read: {' '.join(str(error).split())[:200]}",
            name,
            "write title, maps, models",
        ) from error


def filled(checklist: Checklist, maps: Sequence[Asset], models: Sequence[Asset]) -> Filled:
    """Compare a checklist with the user's files; a map of any size fills its slot.

    Args:
        checklist: the slots.
        maps, models: the user's files.
    """
    by_name = {_bare(asset.path): asset for asset in maps}
    present = [by_name[_bare(each.name)] for each in checklist.maps if _bare(each.name) in by_name]
    missing = [each for each in checklist.maps if _bare(each.name) not in by_name]
    return Filled(checklist, tuple(present), tuple(missing), min(len(models), checklist.models.count))


def _bare(path: str) -> str:
    """Return the name of a map without folder, suffix and size, in lower case."""
    name = path.rsplit("/", 1)[-1]
    name = name.rsplit(".", 1)[0] if name.lower().endswith((".hdr", ".exr")) else name
    return _SIZE.sub("", name).lower()
