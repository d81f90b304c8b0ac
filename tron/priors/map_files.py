"""Folders of maps, in the layouts that tools write them: which file is which field of which view.

A file is known by its relative path alone, field and view in any of these places (FIELD in any spelling of
``ALIASES``, suffix of :mod:`tron.images`):

    FIELD/NAME.png                  one folder a field
    NAME/FIELD.png                  one folder a view
    NAME.FIELD.png, NAME-FIELD.png, NAME_FIELD.png
    NAME/0000.0000.FIELD.jpg        DiffusionRenderer, one frame a clip: chunk, frame, field
    CLIP/0000.0017.FIELD.png        DiffusionRenderer, many frames a clip: known by order only

The last two are what nv-tlabs' inference_inverse_renderer.py and inference_svd_rgbx.py write. RGB<->X's
program shows its maps and saves none; its examples are named NAME-FIELD.png.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from tron.errors import TronError
from tron.images import SUFFIXES

ALIASES = {
    "normal": ("normal", "normals"),
    "base_color": ("basecolor", "base_color", "albedo", "diffuse_albedo"),
    "roughness": ("roughness",),
    "metallic": ("metallic", "metalness", "metallicness", "metallicity"),
    "irradiance": ("irradiance",),
    "sky_mask": ("sky_mask", "skymask", "sky"),
}
"""Spellings of each field, the preferred first where a folder holds several."""

_FIELD_OF = {alias: field for field, aliases in ALIASES.items() for alias in aliases}
_NAMED = re.compile(rf"(.*)[._-]({'|'.join(sorted(_FIELD_OF, key=len, reverse=True))})", re.IGNORECASE)
_NUMBERED = re.compile(r"\d{4,}\.\d{4,}")


@dataclass(frozen=True)
class MapFile:
    """One file: which field it shows, of what, and how much it is preferred (least is best).

    ``view`` is the view's name without its suffix, or the name of the clip where ``frame`` says which.
    """

    path: Path
    field: str
    view: str
    frame: str | None
    rank: tuple[int, int]


def find_maps(folder: Path) -> list[MapFile]:
    """Every map below a folder, sorted by path.

    Raises:
        TronError: the folder is missing.
    """
    if not folder.is_dir():
        raise TronError("folder of prior maps not found", folder, "give the folder that the prior wrote")
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    known = (_known(path, PurePosixPath(path.relative_to(folder).as_posix())) for path in paths)
    return [file for file in known if file is not None]


def _known(path: Path, relative: PurePosixPath) -> MapFile | None:
    folders, stem = list(relative.parts[:-1]), relative.stem
    alias, frame = None, None
    for i, folder in enumerate(folders):
        if folder.lower() in _FIELD_OF:
            alias = folder.lower()
            name = [*folders[:i], *folders[i + 1 :], stem]
            break
    else:
        if stem.lower() in _FIELD_OF and folders:
            alias, name = stem.lower(), folders
        elif match := _NAMED.fullmatch(stem):
            alias, name = match[2].lower(), [*folders, match[1]]
            if _NUMBERED.fullmatch(match[1]):
                name, frame = folders, match[1]
    if alias is None:
        return None
    field = _FIELD_OF[alias]
    rank = (ALIASES[field].index(alias), SUFFIXES.index(path.suffix.lower()))
    return MapFile(path, field, "/".join(name), frame, rank)


def view_key(name: str) -> str:
    """The name of a view as map files know it: forward slashes, no image suffix."""
    path = PurePosixPath(name.replace("\\", "/"))
    return str(path.with_suffix("")) if path.suffix.lower() in SUFFIXES else str(path)


def match_by_name(files: Sequence[MapFile], views: Sequence[str]) -> Mapping[str, Mapping[str, Path]]:
    """view -> field -> file, by the whole name, or by its last part where that tells all views apart.

    Raises:
        TronError: two files are equally good for one field of one view.
    """
    keys = {view: view_key(view) for view in views}
    last = [key.rsplit("/", 1)[-1] for key in keys.values()]
    short = len(set(last)) == len(last)
    by_name: dict[tuple[str, str], list[MapFile]] = {}
    counts: dict[tuple[str, str], int] = {}
    for file in files:
        if file.frame is not None:
            counts[file.view, file.field] = counts.get((file.view, file.field), 0) + 1
        for name in {file.view, file.view.rsplit("/", 1)[-1]} if short else {file.view}:
            by_name.setdefault((name, file.field), []).append(file)
    matched: dict[str, dict[str, Path]] = {view: {} for view in views}
    for view, key in keys.items():
        for field in ALIASES:
            names = (key, key.rsplit("/", 1)[-1]) if short else (key,)
            found = next((by_name[name, field] for name in names if (name, field) in by_name), [])
            # A clip of many frames that happens to bear the name of a view is not that view.
            found = [file for file in found if file.frame is None or counts[file.view, field] == 1]
            if found:
                matched[view][field] = _best(found, view)
    return matched


def match_by_order(files: Sequence[MapFile], views: Sequence[str]) -> Mapping[str, Mapping[str, Path]]:
    """view -> field -> file, the files of a field in the order of their paths, the views in theirs.

    Raises:
        TronError: a field has more or fewer files than there are views.
    """
    matched: dict[str, dict[str, Path]] = {view: {} for view in views}
    for field in ALIASES:
        ranks = sorted({file.rank for file in files if file.field == field})
        chosen = [file for file in files if file.field == field and file.rank == ranks[0]]
        if chosen and len(chosen) != len(views):
            raise TronError(
                f"{len(chosen)} {field} maps for {len(views)} views",
                chosen[0].path.parent,
                "matching by order needs one each; let chunks neither overlap nor be padded",
            )
        for view, file in zip(views, chosen, strict=False):
            matched[view][field] = file.path
    return matched


def _best(files: Sequence[MapFile], view: str) -> Path:
    first, *others = sorted(files, key=lambda file: file.rank)
    if others and others[0].rank == first.rank:
        raise TronError(
            f"two files are the {first.field} of view {view}: {first.path.name} and {others[0].path.name}",
            first.path.parent,
            "keep one",
        )
    return first.path
