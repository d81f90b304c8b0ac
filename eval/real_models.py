"""A folder of real models and maps, ``assets`` and ``hdri``, as arguments of tron-datagen."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

MODEL_FILES = (".gltf", ".glb", ".obj")
MAP_FILES = (".hdr", ".exr")
PLAIN = re.compile(r"[A-Za-z][\w./-]*")
"""Names that need no quotation marks on a command line."""


def has_models(data: Path) -> bool:
    """Whether the folder has both parts."""
    return all((data / name).is_dir() for name in ("assets", "hdri"))


def model_names(data: Path) -> list[str]:
    """Names of its models, sorted."""
    return _names(data / "assets", MODEL_FILES)


def model_arguments(data: Path) -> list[str]:
    """Arguments that give a run the models and maps, licensed or not: what is judged is not handed on."""
    data = data.absolute()
    names = [*model_names(data), *_names(data / "hdri", MAP_FILES)]
    return [
        f"assets={data / 'assets'}",
        f"environments={data / 'hdri'}",
        f"allow_unlicensed={typed_list(names)}",
    ]


def typed_list(names: Sequence[str]) -> str:
    """Names as one types them in a list; in quotation marks where they have spaces, or could be numbers."""
    return f"[{','.join(name if PLAIN.fullmatch(name) else _quoted(name) for name in names)}]"


def _quoted(name: str) -> str:
    escaped = name.replace("'", "\\'")
    return f"'{escaped}'"


def _names(folder: Path, suffixes: Sequence[str]) -> list[str]:
    """Names of a folder's files as tron-datagen calls them, with its subfolders, suffixes in any case.

    A file is called by its stem, or where several have that, by its path without the suffix.
    """
    paths = [path.relative_to(folder) for path in folder.rglob("*") if path.suffix.lower() in suffixes]
    stems = Counter(path.stem for path in paths)
    return sorted(path.stem if stems[path.stem] == 1 else path.with_suffix("").as_posix() for path in paths)
