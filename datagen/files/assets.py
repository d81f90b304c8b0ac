"""The catalogue of the user's assets: each file with its source and licence.

A catalogue is a JSON list beside the files (``catalogue.json``) or elsewhere:

    [{"path": "FlightHelmet/FlightHelmet.gltf", "licence": "CC0-1.0", "author": "...", "source":
    "https://..."}]

``path`` is relative to the folder; ``licence`` is required for use, the rest is for the dataset card. ``up``
may be ``"z"`` for models that do not stand on y. A file without a licence is used only if its name is allowed
explicitly.

Models are read by :mod:`tron.models`.
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from datagen.files.contents import Content, compared, model_contents
from datagen.world.lights import Contrast, HdriSpec, classify
from tron.errors import TronError
from tron.models.load import SUFFIXES, load_model
from tron.models.parts import Part
from tron.shading.environments.environment import EnvironmentMap
from tron.storage import sha256

log = logging.getLogger(__name__)


CATALOGUE_NAME = "catalogue.json"
LARGEST_CATALOGUE = 64 * 2**20
LISTED = 20
"""Names that an error lists at most."""


class Asset(BaseModel):
    """One file that scenes may use.

    Attributes:
        id: its name in specifications: the file's stem, or its path if stems collide.
        path: relative to the folder, with forward slashes.
        sha256: of the file itself (a .gltf's textures are files of their own).
        contents: hashes of its parts, if it was read.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: str
    path: str
    sha256: str
    licence: str | None = None
    author: str | None = None
    source: str | None = None
    up: Literal["y", "z"] = "y"
    contents: tuple[Content, ...] = ()

    def hashes(self) -> frozenset[str]:
        """Hashes of the asset; two assets that share one are the same."""
        return compared(self.contents) or frozenset([self.sha256])


class Refused(BaseModel):
    """A model that cannot be used, with the reason on one line."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: str
    path: str
    reason: str


class Entry(BaseModel):
    """Entry of a catalogue; fields as in :class:`Asset`."""

    model_config = ConfigDict(extra="forbid")

    path: str
    licence: str | None = None
    author: str | None = None
    source: str | None = None
    up: Literal["y", "z"] = "y"


def find_assets(
    folder: Path,
    suffixes: Sequence[str] = SUFFIXES,
    catalogue: Path | None = None,
    allow_unlicensed: Collection[str] | Literal["all"] = (),
    names: Collection[str] = (),
) -> list[Asset]:
    """List the usable files of a folder in order of path.

    Args:
        folder: searched with its subfolders.
        suffixes: what counts as an asset.
        catalogue: JSON file; None looks for catalogue.json in the folder.
        allow_unlicensed: ids to accept without a licence, or all of them.
        names: ids to list; empty: all.

    Raises:
        TronError: the folder or catalogue is missing or unreadable, nothing was found, an id is not there, or
            files have no licence and their ids are not allowed.
    """
    if not folder.is_dir():
        raise TronError("folder of assets not found", folder)
    paths = sorted(
        p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.suffix.lower() in suffixes
    )
    if not paths:
        raise TronError(f"no {', '.join(suffixes)} in the folder", folder)
    entries = read_catalogue(
        catalogue if catalogue is not None else folder / CATALOGUE_NAME, catalogue is not None
    )
    stems = Counter(Path(path).stem for path in paths)
    found = {
        Path(path).stem if stems[Path(path).stem] == 1 else str(Path(path).with_suffix("")): path
        for path in paths
    }
    if missing := sorted(set(names) - found.keys()):
        raise TronError(f"no asset '{missing[0]}'", folder, f"there are {', '.join(found)}")
    assets, unlicensed = [], {}
    for name, path in found.items():
        if names and name not in names:
            continue
        entry = entries.get(path, Entry(path=path))
        if not entry.licence:
            unlicensed[name] = path
        assets.append(Asset(id=name, sha256=sha256(folder / path), **entry.model_dump()))
    require_licences("asset", folder, unlicensed, allow_unlicensed)
    return assets


def require_licences(
    kind: str, folder: Path, unlicensed: Mapping[str, str], allowed: Collection[str] | Literal["all"]
) -> None:
    """Require that the user allowed every file without a licence.

    Args:
        kind: name of the kind of files, one or two words.
        folder: folder of the files.
        unlicensed: id -> path in the folder, of each without a licence.
        allowed: ids to use all the same, or all of them.

    Raises:
        TronError: some are not allowed; it names at most LISTED of them.
    """
    missing = {} if allowed == "all" else {k: path for k, path in unlicensed.items() if k not in allowed}
    if not missing:
        return
    names = list(missing)
    mend = f"state it in {CATALOGUE_NAME}, or use it nevertheless with allow_unlicensed=[{names[0]}]"
    if len(names) == 1:
        raise TronError(f"{kind} '{names[0]}' has no licence", folder / missing[names[0]], mend)
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    raise TronError(
        f"{len(names)} {kind}s have no licence: {', '.join(names[:LISTED])}{more}",
        folder,
        f"state them in {CATALOGUE_NAME}, or use them nevertheless by name, or with allow_unlicensed=all",
    )


def find_models(
    folder: Path,
    catalogue: Path | None = None,
    allow_unlicensed: Collection[str] | Literal["all"] = (),
    names: Collection[str] = (),
) -> tuple[list[Asset], list[Refused]]:
    """List usable and unusable models of a folder; each is read once.

    A model that cannot be used is left out with a warning; asked for by name, it is an error.

    Raises:
        TronError: as :func:`find_assets`, a model of ``names`` that cannot be used, or none that can.
    """
    usable, refused = [], []
    for asset in find_assets(folder, SUFFIXES, catalogue, allow_unlicensed, names):
        try:
            parts = load_model(folder / asset.path, asset.up)
        except TronError as error:
            if names:
                raise
            reason = f"{error.what}: {error.mend}" if error.mend else error.what
            refused.append(Refused(id=asset.id, path=asset.path, reason=" ".join(reason.split())))
        else:
            contents = model_contents(folder, asset.path, parts)
            usable.append(asset.model_copy(update={"contents": contents}))
    for model in refused if usable else ():
        log.warning("model left out: %s: %s", folder / model.path, model.reason)
    if not usable:
        raise TronError(
            f"none of the {len(refused)} models can be used; '{refused[0].id}': {refused[0].reason}", folder
        )
    return usable, refused


def find_environments(
    folder: Path, catalogue: Path | None = None, allow_unlicensed: Collection[str] | Literal["all"] = ()
) -> tuple[list[Asset], list[HdriSpec]]:
    """List the maps of a folder with their measured contrast; raises as :func:`find_assets` does."""
    assets = [
        asset.model_copy(update={"contents": (Content(path=asset.path, kind="map", sha256=asset.sha256),)})
        for asset in find_assets(folder, (".hdr", ".exr", ".dds", ".ktx2"), catalogue, allow_unlicensed)
    ]
    specs = [
        HdriSpec(
            path=a.path, sha256=a.sha256, rotation_deg=0.0, contrast=_contrast(str(folder / a.path), a.sha256)
        )
        for a in assets
    ]
    return assets, specs


@lru_cache(maxsize=4096)
def _contrast(path: str, _sha256: str) -> Contrast:
    return classify(EnvironmentMap.load(path))


def load_models(folder: Path, assets: Sequence[Asset]) -> dict[str, list[Part]]:
    """Load asset id -> its parts in the unit ball, z up; each is read once per process."""
    return {asset.id: _load(str(folder / asset.path), asset.up, asset.sha256) for asset in assets}


@lru_cache(maxsize=64)
def _load(path: str, up: str, _sha256: str) -> list[Part]:
    # Worlds are lit by their environment alone: true irradiance, and many lights at once, know no other.
    return [replace(part, emission=None) for part in load_model(path, up)]


def read_catalogue(path: Path, required: bool) -> dict[str, Entry]:
    """Read path -> entry of a catalogue; empty if there is none.

    Raises:
        TronError: it cannot be read, or is ``required`` and not there.
    """
    if not path.is_file():
        if required:
            raise TronError("catalogue not found", path)
        return {}
    try:
        if path.stat().st_size > LARGEST_CATALOGUE:
            raise ValueError("file is too large to be a catalogue")
        entries = TypeAdapter(list[Entry]).validate_python(json.loads(path.read_text("utf-8")))
    except (OSError, ValueError, RecursionError, ValidationError) as error:
        raise TronError(
            f"catalogue cannot be read: {_reason(error)}", path, 'write [{"path": ..., "licence": ...}, ...]'
        ) from error
    return {entry.path: entry for entry in entries}


def _reason(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"entry {'.'.join(map(str, first['loc']))}: {first['msg']}"
    return str(error)
